"""The renderer of the built-in world: bodies on a street to light, depth, classes and instances of each pixel.

Read `scene` (what goes in and comes out), then `renderer`. Kernels are compiled by numba (`compiled` says how): after
an edit delete the `__pycache__/*.nb*` beside them.
"""
