"""Trained networks that come with rigwake, as ONNX files."""
