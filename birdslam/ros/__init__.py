"""ROS bags without ROS, by the library `rosbags` (the extra `ros`), which only this package imports.

`bag` reads ROS 1 and ROS 2 bags, `sensor` turns their images, cameras and speeds into ours, `frames` has their static
transforms. `messages` are our records as ROS messages, `bag_writer` writes them to a bag. What can't be used raises
`bag.BagError`, which names the bag and the cause.
"""
