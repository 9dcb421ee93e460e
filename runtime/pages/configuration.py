"""The page of all keys (docs/configuration.md), from their questions and the typed fields: `birdslam configuration`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
from msgspec import inspect as kinds

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.fields import ByName, Field, fields, stands_for
from birdslam.runtime.keys import GROUPS, KEYS, Group
from birdslam.runtime.pages.tables import table, unit

_PAGE = """\
# The keys of the configuration

Made by `birdslam configuration > docs/configuration.md` from `runtime/keys.py` and the typed code; a test holds it.

Every key has a default: one setting serves all roads and cameras. A TOML file holds differences only
(`birdslam run FILE.toml`; [configs/vehicle.toml](../configs/vehicle.toml) is an example), and `--set KEY=VALUE` changes
one key for one run: `birdslam run --set perceive.deadline_ms=25`. In a file the parts of a key before its last point
name the table: `[perceive]`, then `deadline_ms = 25`. A word in capitals stands for any name: `models.detector.path`.
An unknown key or a wrong type is an error that names the key. Paths in a file are relative to the file.

These are {count} keys. The other numbers are constants of the method and its processes, and stand typed beside their
formulas (`birdslam.slam.SlamConfig` has the method's): a file that sets one gets an error that says where it is.
Programs vary them from Python, and ablations by `--constant KEY=VALUE`. [constants.md](constants.md) says which of them
data chose.

Units: m, s, rad, px as their keys end; *fraction* is 1 for the whole. *Required* holds within its table alone, which
may be left out.

{groups}
"""
_NAMES: dict[type[kinds.Type], str] = {
    kinds.IntType: "integer",
    kinds.FloatType: "number",
    kinds.StrType: "text",
    kinds.BoolType: "boolean",
    kinds.NoneType: "none",
}


@dataclass(frozen=True)
class Key:
    """One row: a key of the configuration."""

    key: str
    question: str
    unit: str
    default: str
    may_be: str


def page() -> str:
    """The whole page, in Markdown."""
    return _PAGE.format(count=len(KEYS), groups="\n\n".join(map(_markdown, GROUPS)))


def rows(group: Group) -> Iterator[Key]:
    """Those of a group's keys."""
    known = list(fields(Configuration, Configuration()))
    for key, question in group.questions.items():
        alike = [field for field in known if field.key == key or (field.key not in KEYS and stands_for(key, field.key))]
        field = alike[0]
        yield Key(key, question, unit(f"_{field.name}"), _default(alike), _may_be(field.kind))


def _markdown(group: Group) -> str:
    cells = [(f"`{row.key}`", row.question, row.unit, row.default, row.may_be) for row in rows(group)]
    head = f"## {group.title}\n\n" + (f"{group.about}\n\n" if group.about else "")
    return head + table([("key", "question", "unit", "default", "may be"), *cells])


def _default(alike: list[Field]) -> str:
    """Of a key, or of each that a pattern stands for where they differ: "detector 5.0, depth 2.0"."""
    values = {field.key: _value(field.default) for field in alike}
    if isinstance(alike[0].default, ByName):
        return ", ".join(f"{name} {_value(value)}" for name, value in alike[0].default.items())
    if len(set(values.values())) == 1:
        return values[alike[0].key]
    return ", ".join(f"{key.split('.')[-2]} {value}" for key, value in values.items())


def _value(value: Any) -> str:
    if value is msgspec.NODEFAULT:
        return "required"
    return "none" if value is None else f"`{msgspec.json.encode(value).decode()}`"


def _may_be(kind: kinds.Type) -> str:
    """What a value may be, as the type states it."""
    if isinstance(kind, kinds.UnionType):
        return " or ".join(map(_may_be, kind.types))
    if isinstance(kind, kinds.LiteralType):
        return ", ".join(f"`{msgspec.json.encode(value).decode()}`" for value in sorted(kind.values, key=str))
    if isinstance(kind, kinds.VarTupleType):
        return f"list of {_may_be(kind.item_type)}"
    bounds = [("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<")]
    said = [f"{sign} {limit:g}" for name, sign in bounds if (limit := getattr(kind, name, None)) is not None]
    if pattern := getattr(kind, "pattern", None):
        said.append(f"`{pattern}`")
    return f"{_NAMES[type(kind)]} {' and '.join(said)}".strip()
