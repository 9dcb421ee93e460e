"""Worlds without images: drives as edges with exact truth, and odometry with the errors of the real one.

Read `drive` first: seeded `Measurements` for tests and benchmarks of the back end. `odometry` takes the place of the
image odometry in the front end where a benchmark has poses but no images.
"""
