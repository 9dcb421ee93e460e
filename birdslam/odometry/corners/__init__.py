"""Corners: followed by optical flow, resected among landmarks, adjusted in a window of keyframes.

Read `feature_tracks` first, then `relative_pose` and `sliding_window`; `initialisation` is the start from two views.
"""
