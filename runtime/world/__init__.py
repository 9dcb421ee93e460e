"""`make train` and `birdslam demo-drive`: the shipped networks from their seeds, and the shipped drive.

Read `train` first (the multi-task network); `train_lanes` and `train_pointnet` train the other two, `quantise` makes
the int8 network.
"""
