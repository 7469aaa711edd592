"""Local 3D model of the surroundings from LiDAR revolutions and their poses (docs/depth.md).

``local_model`` holds the model and renders it, ``mapper`` feeds it with revolutions and transforms, and ``kernels`` has
the compiled loops.
"""
