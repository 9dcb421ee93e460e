"""Training of the shipped networks on the built-in world (torch, extra `train`; `make train`).

Read `network` first (the multi-task network), then `targets` (training targets of a rendered frame), `losses` and
`trainer`. `lanes` and `pointnet` each contain a smaller network: targets, layers, losses, export.
"""
