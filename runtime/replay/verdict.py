"""The outcome of comparing a recording with its replay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec


@dataclass
class Difference:
    """The first estimate that differs."""

    frame_id: int
    fields: list[tuple[str, Any, Any]]  # where, recorded, replayed


@dataclass
class Verdict:
    """Counts of equal records, and the first difference."""

    equal: int = 0  # estimates, bit for bit
    coasted: int = 0  # of them, without measurements
    unknown: int = 0  # estimates that can't be compared: their measurements are not in the recording
    unanswered: int = 0  # measurements without an estimate
    maps: int = 0  # map updates, bit for bit
    epochs: int = 0
    restarts: int = 0  # of the optimizer
    difference: Difference | None = None
    open_end: int = 0  # at the end of a truncated recording: measurements or estimates without their counterpart

    @property
    def same(self) -> bool:
        """Whether all comparable estimates are equal, and there is at least one."""
        return self.difference is None and self.equal > 0


def differing(recorded: msgspec.Struct, replayed: msgspec.Struct) -> list[tuple[str, Any, Any]]:
    """Returns (where, recorded, replayed) of each number or text that differs."""
    return list(_walk("", msgspec.to_builtins(recorded), msgspec.to_builtins(replayed)))


def _walk(where: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(a, dict) and isinstance(b, dict):
        for key in dict.fromkeys((*a, *b)):
            yield from _walk(f"{where}.{key}".lstrip("."), a.get(key), b.get(key))
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        for number, (one, other) in enumerate(zip(a, b, strict=True)):
            yield from _walk(f"{where}[{number}]", one, other)
    elif a != b:
        yield where, a, b
