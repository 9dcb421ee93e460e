"""What each process does: capture, perceive, optimize, record.

Read `nodes` first (each node in a few lines around its objects of birdslam/), then `runner`, the loop that all of
them run.
"""
