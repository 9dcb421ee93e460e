"""Metric scale from the road: direct alignment of image pairs, and a Kalman filter of scale, tilt and curvature.

Read `scale` first (processing of one image), then `alignment` (one pair of images) and `kalman_filter`.
"""
