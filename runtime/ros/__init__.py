"""Live ROS 2 without a ROS installation: a node at the router of rmw_zenoh.

`session` opens the node, `publisher` (`birdslam ros`) publishes estimates, `camera` receives images and the car's own
speed from topics (`--source ros:/TOPIC`).
"""
