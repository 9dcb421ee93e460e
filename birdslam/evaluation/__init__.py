"""How good the results are: against poses, labels and LiDAR; the paper's tables; the files that a drive leaves.

Read `odometry` first (ATE, RPE and scale of the ego), then `tracking` (every method on one log of measurements, the
paper's Tables 1-5; `ablation` has their variants). `localisation` grades the CV edges, `demo` a run over the
shipped drive; `results`, `picture` and `video` write what a drive leaves on disk.
"""
