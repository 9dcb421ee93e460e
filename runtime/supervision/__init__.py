"""`birdslam run`: starts the processes, watches them, answers planners, and reports at the end.

Read `supervisor` first, then `stations` (the processes of one node, and their restarts).
"""
