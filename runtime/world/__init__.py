"""Trains the shipped networks (`make train`) and renders the shipped drive (`birdslam demo-drive`).

`train` trains the multi-task network, `train_lanes` and `train_pointnet` the other two; `quantise` makes the int8
network.
"""
