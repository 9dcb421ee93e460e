"""Maps that are kept: their files, and what a drive makes of one when it is over."""
