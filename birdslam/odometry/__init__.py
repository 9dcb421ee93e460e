"""Ego-motion from the images of one forward camera, in metres: the CC edges of the pose graph.

Read `odometry` first. `corners` tracks features and adjusts a window of keyframes: the relative pose. `road` aligns
images of the road, whose distance to the camera is known: the metric scale. `speed` has the car's own speed and motion
where images show none; `obstruction` finds what is fixed to the car in front of the camera.
"""
