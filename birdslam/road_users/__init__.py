"""Road users in bird's-eye view with persistent ids: vehicles, cyclists and pedestrians.

docs/road-users.md lists every estimate, its equation and its readers. Read `placement.localisation` first (from a box
to a place on the road), then `tracking`; `models` is the filter of all road users, `state` that of road and sizes.
"""
