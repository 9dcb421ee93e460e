"""What faults do to a running vehicle, what a long drive does, and many vehicles at one router."""
