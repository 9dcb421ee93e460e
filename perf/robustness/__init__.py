"""Robustness: faults of a running vehicle, long drives, variants of videos."""
