"""Meshes of what is rendered: solids, vehicles, people, and what stands beside the street. Compiled by numba."""
