"""Training of the depth network: data, augmentation, losses, SliceNet in torch, export to ONNX."""
