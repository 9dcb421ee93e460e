"""Adapters for detections and tracks of other libraries; none of these libraries is imported."""
