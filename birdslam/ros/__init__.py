"""ROS bags and messages without ROS, by the library `rosbags` (the extra `ros`), which only this package imports.

`bag` reads ROS 1 and ROS 2 bags, `sensor` converts their images, cameras, speeds and fixes, `frames` has their static
transforms. `messages` converts records to ROS messages of `message_types`; `bag_writer` writes them to a bag,
`rmw_zenoh` defines the wire format of a live ROS 2. Unusable input raises `bag.BagError`.
"""
