"""Storage, comparison and reports of results; `all` runs all benchmarks."""
