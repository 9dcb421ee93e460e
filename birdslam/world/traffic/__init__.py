"""Who and what is on a street of the built-in world, and how it moves; numpy alone.

Read `flow` first: `populate` puts traffic on a street, `advance` moves it. `poses` takes (s, d) on the street to
poses in world.
"""
