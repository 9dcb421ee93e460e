"""Benchmarks: `python -m perf NAME`, one module each, which prints its figures and can write them as JSON.

perf/README.md says what each measures and what came of it; `figures` has what they share.
"""
