"""Common parts of all processes of a vehicle: start (`child`), scheduling, heartbeat, restarts, systemd."""
