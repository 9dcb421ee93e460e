"""`birdslam run`: starts the processes, watches them, answers planners, and reports at the end.

Read `supervisor` first, then `stations` (a node's place in a run, and the rule by which it is started again).
"""
