"""ONNX files: reading, speeding up, and conversion from OpenVINO's format."""
