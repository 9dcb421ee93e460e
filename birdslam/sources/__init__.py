"""Recordings in: frames, camera and truth of KITTI drives, video files, ROS bags and the shipped drive.

Read `recording` first: the interface that `kitti`, `video`, `rosbag` and `shipped_drive` implement. `schemes` is the
table of them all, by which `opening` opens any by its URI. `kitti_tracking` has the labels and detections of KITTI's
tracking benchmark. Whatever can't be read raises `recording.DatasetError`, which names the path and the cause.
"""
