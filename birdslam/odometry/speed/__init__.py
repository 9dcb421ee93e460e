"""The car's own speed, the metric scale from it, and motion where images show none."""
