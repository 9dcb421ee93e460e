"""Counts the calls of a function, for tests of how much work something is."""

from __future__ import annotations

import sys
from collections.abc import Callable


def calls(function: Callable[[], object], event: str) -> int:
    """The calls of Python's functions ("call"), or of those in C ("c_call"), while `function` runs."""
    count = 0

    def counting(frame: object, came: str, argument: object) -> None:
        nonlocal count
        count += came == event

    before = sys.getprofile()
    sys.setprofile(counting)
    try:
        function()
    finally:
        sys.setprofile(before)
    return count
