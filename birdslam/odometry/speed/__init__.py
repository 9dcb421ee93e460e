"""The car's own speed and the metric scale from it; zero-velocity detection and a velocity prior."""
