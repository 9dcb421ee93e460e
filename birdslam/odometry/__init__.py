"""Metric visual odometry of one forward camera: the CC edges of the pose graph.

Read `odometry` first. `corners` estimates the relative pose from feature tracks. `road` estimates the metric scale from
images of the road. `speed` uses the car's own speed, zero-velocity updates and a velocity prior. `obstruction` detects
what is fixed to the car in front of the camera.
"""
