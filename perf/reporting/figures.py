"""Storage of results: distributions, in a file that is complete after every row."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from birdslam.perf.reporting.machine import Steal, describe, describe_text


def spread(values: ArrayLike) -> dict[str, float]:
    """p50, p99, p999, max and count of a series; only the count if it is empty."""
    series = np.asarray(values, dtype=np.float64)
    if not series.size:
        return {"n": 0}
    p50, p99, p999 = np.percentile(series, [50.0, 99.0, 99.9])
    found = {"p50": p50, "p99": p99, "p999": p999, "max": series.max()}
    return {name: round(float(value), 4) for name, value in found.items()} | {"n": int(series.size)}


class Ledger:
    """One benchmark's results, written to `path` (None: not written) after each row; a context manager.

    On Ctrl-C the results so far are kept and `complete` stays false.
    """

    def __init__(self, path: Path | None, label: str, **settings: Any) -> None:
        self.path = path
        self.content: dict[str, Any] = {
            "label": label,
            "command": f"python -m perf {shlex.join(sys.argv[1:])}",
            "complete": False,
            "settings": settings,
            "machine": describe(),
            "rows": [],
        }
        self._steal = Steal()
        print(describe_text(self.content["machine"]), file=sys.stderr)

    def add(self, name: str, shown: str, **row: Any) -> None:
        """Adds a row with a unique name, and prints it as `shown`."""
        self.content["rows"].append({"name": name, **row})
        self._write()
        print(f"{name:44} {shown}", flush=True)

    def set(self, **figures: Any) -> None:
        """Sets results outside the rows."""
        self.content |= figures
        self._write()

    def _write(self) -> None:
        self.content["steal_percent"] = self._steal.percent()
        if self.path is not None:
            write_json(self.path, self.content)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *failure: object) -> None:
        self.content["complete"] = kind is None
        self._write()


def write_json(path: Path, content: Any) -> None:
    """Writes a file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".draft")
    draft.write_text(json.dumps(content, indent=1, default=_plain) + "\n", encoding="utf-8")
    draft.replace(path)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a report can't contain a {type(value).__name__}")


def spread_text(figures: dict[str, float], unit: str) -> str:
    """A spread as text."""
    if not figures.get("n"):
        return "nothing came"
    return "  ".join(f"{name} {figures[name]:.3g}" for name in ("p50", "p99", "max")) + f" {unit}"
