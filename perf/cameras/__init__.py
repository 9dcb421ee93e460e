"""Benchmarks of what is found of a camera: its lens, its height, how it is mounted."""
