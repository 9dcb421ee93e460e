"""Selects the cases of a parametrized test that run on each change; `make test-slow` runs the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first(count: int, cases: Iterable[Any]) -> list[Any]:
    """Marks all but the first cases as `slow`; a tuple has the values of one case."""
    found = list(cases)
    return [
        *found[:count],
        *(pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=pytest.mark.slow) for c in found[count:]),
    ]
