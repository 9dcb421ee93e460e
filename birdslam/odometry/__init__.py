"""Ego-motion from the images of one forward camera, in metres: the CC edges of the pose graph.

Read `odometry` first. `corners` follows features from image to image and adjusts a window of keyframes: the relative
pose. `road` compares images of the road, whose camera height is known: its metres. `speed` is what the car itself
says, and what holds where images show nothing; `obstruction` masks what stands before the camera.
"""
