"""The back end: the paper's incremental SE(2) pose graph (Eqs. 2-8).

Read `pose_graph` first: one update a frame takes `Measurements` to an `Estimate`. `factors` has the terms of the cost,
`minimum` finds its minimum (Eq. 8), `window` has the newest poses, `weights` what an edge weighs: its covariance, or
the paper's numbers.
"""
