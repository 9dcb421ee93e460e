"""ROS 2 live, without ROS: as a node among those of rmw_zenoh, at its router.

`session` opens and names the node, `publisher` (`birdslam ros`) says what BirdSLAM says, `camera` takes images and the
car's own speed from topics (`--source ros:/TOPIC`).
"""
