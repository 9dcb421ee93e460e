"""Recordings: frames, camera and ground truth of KITTI drives, video files, ROS bags and the shipped drive.

Read `recording` first: the interface of `kitti`, `video`, `rosbag` and `shipped_drive`. `schemes` is their table,
`opening` opens one by URI. `kitti_tracking` has the labels and detections of KITTI's tracking benchmark. All errors
are `recording.DatasetError` and name the path and the cause.
"""
