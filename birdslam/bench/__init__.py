"""What judges the method: against poses, labels and LiDAR, beside other methods, and on simulated drives.

Nothing of the method imports it. `ego` grades trajectories, `tracking` has the paper's tables, `baselines` what it
compares with, `simulation` drives without images.
"""
