"""Latency of the whole system, its processes, and its parts compared with other libraries."""
