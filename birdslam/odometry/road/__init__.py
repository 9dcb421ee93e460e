"""The road's image: direct alignment of two images, and a Kalman filter of scale, tilt and curvature over them.

Read `scale` first (the metric scale), then `alignment` (one comparison) and `kalman_filter` (all of them).
"""
