"""Networks as ONNX or torch.export archives, with what is needed to run them elsewhere."""
