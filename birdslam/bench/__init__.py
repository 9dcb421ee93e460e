"""Evaluation of the method against poses, labels and LiDAR, beside other methods.

Nothing of the method imports it. `ego` evaluates trajectories, `tracking` has the paper's tables, `baselines` the other
methods of these tables, `simulation` odometry for sequences without images.
"""
