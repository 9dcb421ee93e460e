"""Shared geometry: SE(2), rigid motions in space, the camera over the road, and Eq. 1.

Read `se2` first (poses `T_a_b` on the road plane; `planar` is the same on arrays), then `camera` and `bev`, which
converts pixels of the road to metres and back.
"""
