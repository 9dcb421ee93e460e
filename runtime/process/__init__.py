"""What every process of a vehicle has: scheduling, signs of life, restarts, and what it tells systemd.

Read `child` first: what a process does before its work begins.
"""
