"""The same road twice: places recognised, maps that are kept, localisation in them, loops closed.

A `PlaceMap` is keyframes every few metres: points with binary descriptors, no images. `MapSession.step` takes a frame
and its estimate, tells where the ego is in the map and makes the map grow. Off the hot path, pure and deterministic.
"""
