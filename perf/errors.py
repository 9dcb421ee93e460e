"""Errors that a user of the suite can fix."""


class PerfError(ValueError):
    """An error printed as one line on standard error, with exit status 2."""
