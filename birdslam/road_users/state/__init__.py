"""Filters of vehicles over time: size, motion, yaw, and the tilt of their road."""
