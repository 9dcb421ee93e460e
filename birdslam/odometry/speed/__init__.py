"""The car's own speed, the metric scale by it, and what holds where images show no motion: zero velocity, a prior."""
