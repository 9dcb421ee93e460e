"""Vehicles against labels: the paper's Tables 1-5 and more.

Read `benchmark` first (every method on one log of measurements; `ablation` has their variants). `localisation` grades
the CV edges, `shipped_drive` a run over the shipped drive, `reported` the live estimates that a planner receives.
"""
