"""Film files: frames and container metadata."""
