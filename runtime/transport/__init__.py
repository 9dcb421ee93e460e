"""Communication between processes: typed topics and queries over zenoh, images over shared memory.

Read `bus` first (a node's session with its publishers and subscribers), then `ring` (images) and `queries`.
"""
