"""The page of all keys (docs/configuration.md), made from the typed structs: `birdslam configuration` prints it."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
from msgspec import inspect as kinds

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.pages.tables import comments, table, unit

_PAGE = """\
# Every key of the configuration

Made by `birdslam configuration > docs/configuration.md` from the typed code; a test holds it to the code.

Every key has a default: one setting serves all roads and cameras. A TOML file holds differences only
(`birdslam run FILE.toml`; [configs/vehicle.toml](../configs/vehicle.toml) is an example), and `--set KEY=VALUE` changes
one key for one run: `birdslam run --set perceive.deadline_ms=25`. In a file the parts of a key before its last point
name the table: `[perceive]`, then `deadline_ms = 25`. An unknown key or a wrong type is an error that names the key.
Paths in a file are relative to the file.

Units: m, s, rad, px as their keys end; *fraction* is 1 for the whole; *sigma* counts standard deviations. A default of
*none* is what the meaning says of None; *required* holds within its table alone, which may be left out.

{sections}
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
    unit: str
    default: str
    may_be: str
    meaning: str


@dataclass(frozen=True)
class Section:
    """One table of the configuration: its name ("" for the top), what it is about, and its own keys."""

    name: str
    about: str
    keys: tuple[Key, ...]


def page() -> str:
    """The whole page, in Markdown."""
    return _PAGE.format(sections="\n\n".join(_markdown(section) for section in sections()))


def sections() -> list[Section]:
    """Every table of the configuration, outer ones first."""
    return list(_sections(Configuration, "", Configuration(), ""))


def _markdown(section: Section) -> str:
    head = f"## {section.name or 'The top'}\n\n{section.about}".rstrip()
    if not section.keys:
        return head
    rows = [(f"`{key.key}`", key.unit, key.default, key.may_be, key.meaning) for key in section.keys]
    return f"{head}\n\n{table([('key', 'unit', 'default', 'may be', 'meaning'), *rows])}"


def _sections(kind: type[msgspec.Struct], name: str, values: Any, said: str) -> Iterator[Section]:
    """The table of a struct, then those within it. `values` is its default: a struct, structs by name, or None."""
    about = " ".join(inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0].split())
    keys, inner = [], []
    meanings = comments(kind)
    info = kinds.type_info(kind)
    assert isinstance(info, kinds.StructType)
    for field in info.fields:
        key = f"{name}.{field.name}".lstrip(".")
        nested = _struct_in(field.type)
        default = _default(values, field)
        if nested is None:
            told = _told(default) if isinstance(default, _ByName) else _value(default)
            keys.append(Key(key, unit(field.name), told, _may_be(field.type), meanings.get(field.name, "")))
        elif isinstance(field.type, kinds.DictType):
            inner.append((nested, f"{key}.NAME", _ByName(default), meanings.get(field.name, "")))
        else:
            inner.append((nested, key, default, meanings.get(field.name, "")))
    yield Section(name, f"{about} {_sentence(said)}".strip(), tuple(keys))
    for found in inner:
        yield from _sections(*found)


class _ByName(dict[str, Any]):
    """Defaults that differ from name to name."""


def _default(values: Any, field: kinds.Field) -> Any:
    if isinstance(values, _ByName):
        return _ByName({name: getattr(value, field.name) for name, value in values.items()})
    if values is not None:
        return getattr(values, field.name)
    if field.default is not msgspec.NODEFAULT:
        return field.default
    return msgspec.NODEFAULT if field.required else field.default_factory()


def _told(by_name: _ByName) -> str:
    return ", ".join(f"{name} {_value(value)}" for name, value in by_name.items())


def _value(value: Any) -> str:
    if value is msgspec.NODEFAULT:
        return "required"
    return "none" if value is None else f"`{msgspec.json.encode(value).decode()}`"


def _struct_in(kind: kinds.Type) -> type[msgspec.Struct] | None:
    """The struct that a field holds: itself, or None, or one for each name."""
    if isinstance(kind, kinds.StructType):
        return kind.cls
    if isinstance(kind, kinds.DictType):
        return _struct_in(kind.value_type)
    if isinstance(kind, kinds.UnionType):
        return next((found for inner in kind.types if (found := _struct_in(inner))), None)
    return None


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


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}." if text else ""
