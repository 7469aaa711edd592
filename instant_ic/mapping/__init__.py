"""Local 3D model of the surroundings: LiDAR revolutions accumulated by pose (docs/depth.md). Arrays in, arrays out.

``local_model`` is the model and its rendering, ``mapper`` feeds it from revolutions and transforms, ``kernels`` are the
compiled loops.
"""
