"""How good the ego's trajectory is, and how true its covariance. Read `trajectory_errors` first (ATE, RPE, scale)."""
