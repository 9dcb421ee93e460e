"""`make train`: the shipped networks from their seeds.

Read `train` first (the multi-task network); `train_lanes` and `train_pointnet` train the other two, `quantise` makes
the int8 network.
"""
