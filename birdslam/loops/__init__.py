"""Place recognition, persistent maps, localisation in them, and loop closure.

A `PlaceMap` has keyframes every few metres: points with binary descriptors, no images. `MapSession.step` takes a frame
and its estimate, localises the ego in the map and extends the map. Not real-time, deterministic.
"""
