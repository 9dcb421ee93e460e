"""What a user of the suite can mend."""


class PerfError(ValueError):
    """One line on standard error and exit status 2, as `birdslam` has it."""
