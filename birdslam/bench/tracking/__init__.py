"""Vehicles against labels: the paper's Tables 1-5, depth errors, and the shipped drive.

Read `benchmark` first (all methods on one log of measurements; `ablation` has their variants). `localisation` evaluates
the CV edges, `shipped_drive` a run over the shipped drive.
"""
