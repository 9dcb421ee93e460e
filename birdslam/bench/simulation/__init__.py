"""Odometry with the errors of the real one, for sequences without images."""
