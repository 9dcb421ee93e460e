"""Benchmarks: `python -m perf NAME`, one module each, which prints its results and can write them as JSON.

perf/README.md describes each and its results; `figures` has the common parts.
"""
