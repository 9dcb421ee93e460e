"""The renderer of the built-in world: light, depth, classes and instances of each pixel.

Read `scene` (input and output), then `renderer`. numba compiles the kernels (see `compiled`); after an edit delete the
`__pycache__/*.nb*` beside them.
"""
