"""Benchmarks of kept maps: place recognition, localization in a map, loop closure."""
