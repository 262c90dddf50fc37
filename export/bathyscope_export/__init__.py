"""Export: a checkpoint becomes a bundle of ONNX graphs over one weights file."""
