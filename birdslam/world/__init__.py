"""The built-in world: a street with traffic, seen by a car's camera, with exact truth (numba, extra `train`).

`world.sample(seed, ...)` gives one frame of a world of its own, `World(seed).frames(n)` a drive, both as
`truth.WorldFrame`. Each module says what it does.
"""
