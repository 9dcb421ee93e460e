"""A recording's measurements through the back end again, and a comparison with what was recorded.

Read `replay` first; `verdict` says what a comparison came to, `report` prints it.
"""
