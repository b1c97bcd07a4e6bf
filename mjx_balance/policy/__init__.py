"""The exported policy: file, heads, ONNX."""
