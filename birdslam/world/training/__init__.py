"""Training of the shipped networks on the built-in world (torch, extra `train`; `make train`).

Read `network` first (the multi-task network), then `targets` (from a rendered frame to what it shall answer),
`losses` and `trainer`. `lanes` and `pointnet` each have a smaller network whole: targets, layers, losses, export.
"""
