"""The camera file from a drive: the camera's mounting over the road, and its intrinsics from other tools' files.

Read `calibration` first (pitch, roll, and a check of the height); `intrinsics` reads KITTI, ROS and OpenCV files and
chessboard images.
"""
