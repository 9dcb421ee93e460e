"""Vehicles in bird's-eye view with persistent ids: the CV and VV edges of the pose graph.

docs/road-users.md lists every estimate of a vehicle, its equation and its readers. Read `placement.localisation` first
(from a box to a place on the road), then `tracking`; `state` has the filters over time.
"""
