"""Means and medians of what is known, and tables of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np


def mean(values: Iterable[float | None]) -> float | None:
    """Of those that are not None; None where there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def median(values: Iterable[float | None]) -> float | None:
    """Of those that are not None; None where there are none."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def number(value: float | None, digits: int = 2) -> str:
    """A cell of a table."""
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"
