"""Edits ONNX files for speed: removes unread outputs and subnormal weights."""
