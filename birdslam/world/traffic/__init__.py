"""Road users and scenery on a street of the built-in world, and their motion; numpy only.

Read `flow` first: `populate` places traffic on a street, `advance` moves it. `poses` converts (s, d) on the street to
poses in world.
"""
