"""360° depth: the SliceNet network, its training, ONNX inference and the scaling by LiDAR.

Nothing heavy is imported here: ``slicenet``, ``training`` and ``export`` need torch, ``model`` needs onnxruntime,
``metrics`` and ``scaler`` need only numpy.
"""
