"""The built-in world: a street with traffic, seen by a car's camera, with exact truth (numba, extra `train`).

`world.sample(seed, ...)` gives one frame of an independent world, `World(seed).frames(n)` a drive, both as
`truth.WorldFrame`.
"""
