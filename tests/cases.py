"""Which cases of a law run on each change, and which by `make test-slow` alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first(count: int, cases: Iterable[Any]) -> list[Any]:
    """The first so many of the cases on each change, the others marked `slow`; a tuple is the values of one case."""
    found = list(cases)
    return [
        *found[:count],
        *(pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=pytest.mark.slow) for c in found[count:]),
    ]
