"""What the paper compares BirdSLAM with, each a `run` on the same log of `Measurements`.

Re-implementations from the papers' descriptions: their code, tuned parameters and inputs are not at hand. Each module
says what it keeps and what it can't.
"""
