"""360° depth at run time: ONNX inference, the scaling by LiDAR, depth from LiDAR, and the fusion of both.

Nothing heavy is imported here: ``model`` needs onnxruntime, ``metrics`` and ``scaler`` need only numpy.
"""
