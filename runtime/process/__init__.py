"""What every process of a vehicle has: scheduling, heartbeat, restarts, notifications to systemd.

Read `child` first: what a process does before its work begins.
"""
