"""docs/pages.json: of each page that is measured when, with what code and data, where, and how long it took.

`python -m perf pages --write` keeps it. A page in Markdown ends with the same (`stamp`), as the README's table does.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

import msgspec

from birdslam.perf.reporting.machine import ROOT, describe

FILE = ROOT / "docs" / "pages.json"
LIBRARIES = ("python", "numpy", "opencv-python-headless", "onnxruntime")  # whose versions decide figures
UNKNOWN = "unknown"  # a digest that was not kept yet
BEGINNING = "Measured with code "


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """What was so when a page was written."""

    date: str  # UTC
    commit: str  # that was checked out, "+" behind it with changes in the working tree
    code: str = UNKNOWN  # digests: of the code with its files and the command,
    data: str = UNKNOWN  # and of recordings and networks
    takes_s: float | None = None
    machine: str = ""
    versions: dict[str, str] = {}


def now(code: str, data: str, takes_s: float) -> Measured:
    """Of this machine and this working tree."""
    here = describe()
    return Measured(
        date=here["utc"][:10],
        commit=here["commit"] + "+" * bool(here["uncommitted_files"]),
        code=code,
        data=data,
        takes_s=round(takes_s, 1),
        machine=f"{here['cpu']}, {here['cores']} cores",
        versions={name: here["versions"][name] for name in LIBRARIES},
    )


def load() -> dict[str, Measured]:
    """By the page's name."""
    return msgspec.json.decode(FILE.read_bytes(), type=dict[str, Measured])


def save(kept: Mapping[str, Measured]) -> None:
    """In the order of names, so that a page's renewal is one change."""
    FILE.write_bytes(msgspec.json.format(msgspec.json.encode(dict(sorted(kept.items()))), indent=1) + b"\n")


def duration(seconds: float | None) -> str:
    """As a person says it."""
    if seconds is None:
        return "?"
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


def stamp(name: str, page: Measured) -> str:
    """The last line of a page in Markdown."""
    where = f" on {page.machine}" if page.machine else ""
    after = f", in {duration(page.takes_s)}" if page.takes_s is not None else ""
    text = f"{BEGINNING}`{page.code}` at commit `{page.commit}` on {page.date}{where}{after}"
    return f"{text}: `python -m perf pages --write {name}`."


def stamped(text: str, name: str, page: Measured) -> str:
    """A page with its last line."""
    lines = text.rstrip("\n").split("\n")
    if lines[-1].startswith(BEGINNING):
        lines = lines[:-2]
    return "\n".join((*lines, "", stamp(name, page))) + "\n"


def line(kept: Mapping[str, Measured], parts: Mapping[str, str]) -> str:
    """What stands under a table of figures: the code of each, by what it is of, and the age of the oldest."""
    by_code: dict[str, list[str]] = {}
    for name, what in parts.items():
        by_code.setdefault(kept[name].code, []).append(what)
    codes = ", ".join(f"`{code}` ({', '.join(of)})" for code, of in by_code.items())
    oldest = min(kept[name].date for name in parts)
    text = f"{BEGINNING}{codes}, the oldest on {oldest}; `make#pages` says which figures are older than the code."
    return textwrap.fill(text, 120, break_on_hyphens=False).replace("make#pages", "make pages")
