"""ROS bags and messages without ROS, by the library `rosbags` (the extra `ros`), which only this package imports.

`bag` reads ROS 1 and ROS 2 bags, `sensor` turns their images, cameras, speeds and fixes into ours, `frames` has their
static transforms. `messages` are our records as ROS messages, of the types of `message_types`; `bag_writer` writes them
to a bag, `rmw_zenoh` names them for a live ROS 2. Unusable input raises `bag.BagError`.
"""
