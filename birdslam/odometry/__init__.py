"""Ego-motion from the images of one forward camera, in metres: the CC edges of the pose graph.

Read `odometry` first. Features are followed from image to image, a bundle adjustment over a window of keyframes
gives the relative pose, and the image of the road, whose camera height is known, gives its metres.
"""
