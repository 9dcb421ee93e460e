"""Vehicles in bird's-eye view, with ids that last: the CV and VV edges of the pose graph.

docs/road-users.md has every estimate of a vehicle, its equation and who reads it. Read `placement.localisation` first
(a box to a place on the road), then `tracking`; `state` has the filters of what is learned of a vehicle over time.
"""
