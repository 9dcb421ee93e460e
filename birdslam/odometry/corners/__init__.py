"""Feature corners: tracked by optical flow, resected against landmarks, adjusted over a window of keyframes.

Read `feature_tracks` first, then `selection`, `resection` and `sliding_window`. `initialisation` and `two_view` give
the first motion, where there are no landmarks yet.
"""
