"""The back end: the paper's incremental SE(2) pose graph (Eqs. 2-8).

Read `pose_graph` first: one update a frame takes `Measurements` to an `Estimate`. `window` has the newest poses,
`minimum` finds them by Eq. 8, `landmarks` has the static map, `weights` what an edge weighs: its own covariance, or the
paper's numbers.
"""
