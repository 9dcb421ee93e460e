"""Lanes: lines of paint and road edges as curves in the ego's frame, and the lanes between them.

`LineTracker` is the front end's part: the lines of each image, filtered over the drive. `lanes_of` makes lanes of
lines.
"""
