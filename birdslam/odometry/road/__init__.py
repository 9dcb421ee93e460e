"""The metric scale from the road: direct alignment of two images, and a Kalman filter of scale, tilt and curvature.

Read `scale` first (what happens with an image), then `alignment` (one pair of images) and `kalman_filter` (all pairs).
"""
