"""Meshes: solids, vehicles, people, and scenery. Compiled by numba."""
