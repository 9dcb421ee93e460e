"""Every field of the typed configuration, by its key: what a file's keys and `--constant` are held to.

A table for each name ("vehicles.car") counts once, as NAME.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect as kinds

from birdslam.runtime.keys import KEYS

ANY_NAME = "NAME"


@dataclass(frozen=True)
class Field:
    """One value of the configuration."""

    key: str  # slam.graph.ego_nodes
    struct: type[msgspec.Struct]  # the table that it is in: GraphConfig
    kind: kinds.Type
    default: Any  # msgspec.NODEFAULT: required; ByName where it differs from name to name

    @property
    def name(self) -> str:
        """Of the struct's field."""
        return self.key.rpartition(".")[2]

    @property
    def place(self) -> str:
        """Where the code states it: "GraphConfig in birdslam/graph/graph_config.py"."""
        return f"{self.struct.__name__} in {self.struct.__module__.replace('.', '/')}.py"


class ByName(dict[str, Any]):
    """Defaults that differ from name to name."""


def fields(struct: type[msgspec.Struct], default: Any = None, prefix: str = "") -> Iterator[Field]:
    """Those of a struct and of the structs within it, outer ones first. `default` is an instance, or None."""
    inner = []
    for field in _own(struct):
        key, value = f"{prefix}{field.name}", _default(default, field)
        nested = _struct_in(field.type)
        if nested is None:
            yield Field(key, _stated_by(struct, field.name), field.type, value)
        elif isinstance(field.type, kinds.DictType):
            inner.append((nested, ByName(value or {}), f"{key}.{ANY_NAME}."))
        else:
            inner.append((nested, value, f"{key}."))
    for found in inner:
        yield from fields(*found)


@cache
def _own(struct: type[msgspec.Struct]) -> tuple[kinds.Field, ...]:
    """A struct's fields without those of the structs within it; msgspec translates its annotations again each time."""
    info = kinds.type_info(struct)
    assert isinstance(info, kinds.StructType)
    return info.fields


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The keys of nested tables: {"a": {"b": 1}} has a.b."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def laid_over(tree: dict[str, Any], changes: Any) -> Any:
    """Nested tables with the values of others in place of theirs."""
    if not isinstance(changes, dict):
        return changes
    return tree | {k: laid_over(tree[k], v) if isinstance(tree.get(k), dict) else v for k, v in changes.items()}


def differences(tree: dict[str, Any], default: dict[str, Any]) -> dict[str, Any]:
    """What of nested tables is not as in others."""
    changed = {k: v for k, v in tree.items() if v != default[k]}
    return {k: differences(v, default[k]) if isinstance(v, dict) else v for k, v in changed.items()}


def is_key(name: str) -> bool:
    """Whether a file may set it."""
    return any(stands_for(pattern, name) for pattern in KEYS)


def parted(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The keys of users among settings, and the constants, as `load` takes them."""
    keys = {name: value for name, value in settings.items() if is_key(name)}
    return keys, {name: value for name, value in settings.items() if name not in keys}


def why_no_key(name: str, configuration: type[msgspec.Struct]) -> str:
    """Of a field that no file may set: where it stands and how it is varied. "" of a key, and of what is no field."""
    field = None if is_key(name) else next((f for f in fields(configuration) if stands_for(f.key, name)), None)
    if field is None:
        return ""
    return (
        f"is a constant now and no key any more: field {field.name} of {field.place}. "
        f'To vary it: --constant {name}=VALUE, or from Python load(..., constants={{"{name}": VALUE}})'
    )


def stands_for(pattern: str, key: str) -> bool:
    """Whether a key is one of a pattern's, whose words in capitals stand for any: models.ROLE.path."""
    words, names = pattern.split("."), key.split(".")
    return len(words) == len(names) and all(w == n or w.isupper() for w, n in zip(words, names, strict=True))


def _stated_by(struct: type[msgspec.Struct], name: str) -> type[msgspec.Struct]:
    """The struct or the base of it that the field stands in."""
    return next(base for base in struct.__mro__ if name in inspect.get_annotations(base))


def _default(values: Any, field: kinds.Field) -> Any:
    if isinstance(values, ByName):
        return ByName({name: getattr(value, field.name) for name, value in values.items()})
    if values is not None and values is not msgspec.NODEFAULT:
        return getattr(values, field.name)
    if field.default is not msgspec.NODEFAULT:
        return field.default
    return msgspec.NODEFAULT if field.required else field.default_factory()


def _struct_in(kind: kinds.Type) -> type[msgspec.Struct] | None:
    """The struct that a field holds: itself, or None, or one for each name."""
    if isinstance(kind, kinds.StructType):
        return kind.cls
    if isinstance(kind, kinds.DictType):
        return _struct_in(kind.value_type)
    if isinstance(kind, kinds.UnionType):
        return next((found for inner in kind.types if (found := _struct_in(inner))), None)
    return None
