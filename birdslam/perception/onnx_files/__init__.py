"""ONNX files: outputs that nobody reads and weights that slow a processor down are taken out."""
