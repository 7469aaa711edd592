"""Training of the depth network: data, augmentation, losses, the completion network, export to ONNX."""
