"""360° depth at run time: ONNX inference, scaling by LiDAR, depth from LiDAR, and the fusion of both.

This package imports nothing heavy: ``model`` needs onnxruntime, ``metrics`` and ``scaler`` need only numpy.
"""
