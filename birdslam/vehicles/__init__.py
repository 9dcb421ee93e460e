"""Vehicles in bird's-eye view, with ids that last: the CV and VV edges of the pose graph.

Read `placement.localisation` first (a box to a place on the road, by Eq. 1 and by what is known of the road and of the
vehicle's size), then `tracking` (association, and a constant-velocity filter for each vehicle). `state` has the filters
of what is learned of a vehicle over time.
"""
