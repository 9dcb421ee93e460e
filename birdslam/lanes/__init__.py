"""Lanes: lines of paint and road edges as curves in the ego's frame, and the lanes between them.

Read `line_tracker` first (the lines of each image, filtered over the drive), then `topology` (lanes from lines).
"""
