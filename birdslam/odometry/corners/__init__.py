"""Relative pose from feature tracks: optical flow, resection, and bundle adjustment over a window of keyframes.

Read `feature_tracks` first, then `selection`, `resection` and `sliding_window`. `initialisation` and `two_view`
estimate the first motion, before there are landmarks.
"""
