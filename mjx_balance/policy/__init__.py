"""Exported policies: file, manifest, NumPy network, heads, ONNX."""
