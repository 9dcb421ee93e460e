"""ONNX files: read, made faster, and made of OpenVINO's format."""
