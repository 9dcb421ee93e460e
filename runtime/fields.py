"""The fields of the typed configuration by key.

A table per name ("vehicles.car") has the key NAME.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect as kinds

ANY_NAME = "NAME"


@dataclass(frozen=True)
class Field:
    """One value of the configuration."""

    key: str  # slam.graph.ego_nodes
    struct: type[msgspec.Struct]  # its table: GraphConfig
    kind: kinds.Type
    default: Any  # msgspec.NODEFAULT: required; ByName: one per name

    @property
    def name(self) -> str:
        """The name of the struct's field."""
        return self.key.rpartition(".")[2]


class ByName(dict[str, Any]):
    """Defaults per name."""


def fields(struct: type[msgspec.Struct], default: Any = None, prefix: str = "") -> Iterator[Field]:
    """Yields the fields of a struct and of its nested structs, outer ones first. `default`: an instance, or None."""
    inner = []
    for field in _own(struct):
        key, value = f"{prefix}{field.name}", _default(default, field)
        nested = _struct_in(field.type)
        if nested is None:
            yield Field(key, struct, field.type, value)
        elif isinstance(field.type, kinds.DictType):
            inner.append((nested, ByName(value or {}), f"{key}.{ANY_NAME}."))
        else:
            inner.append((nested, value, f"{key}."))
    for found in inner:
        yield from fields(*found)


@cache
def _own(struct: type[msgspec.Struct]) -> tuple[kinds.Field, ...]:
    """Returns a struct's own fields; cached, since msgspec evaluates the annotations at each call."""
    info = kinds.type_info(struct)
    assert isinstance(info, kinds.StructType)
    return info.fields


def laid_over(tree: dict[str, Any], changes: Any) -> Any:
    """Returns nested tables updated with `changes`."""
    if not isinstance(changes, dict):
        return changes
    return tree | {k: laid_over(tree[k], v) if isinstance(tree.get(k), dict) else v for k, v in changes.items()}


def differences(tree: dict[str, Any], default: dict[str, Any]) -> dict[str, Any]:
    """Returns the entries of nested tables that differ from `default`."""
    changed = {k: v for k, v in tree.items() if v != default[k]}
    return {k: differences(v, default[k]) if isinstance(v, dict) else v for k, v in changed.items()}


def stands_for(pattern: str, key: str) -> bool:
    """Whether a key matches a pattern, whose words in capitals match any word: models.ROLE.path."""
    words, names = pattern.split("."), key.split(".")
    return len(words) == len(names) and all(w == n or w.isupper() for w, n in zip(words, names, strict=True))


def _default(values: Any, field: kinds.Field) -> Any:
    if isinstance(values, ByName):
        return ByName({name: getattr(value, field.name) for name, value in values.items()})
    if values is not None and values is not msgspec.NODEFAULT:
        return getattr(values, field.name)
    if field.default is not msgspec.NODEFAULT:
        return field.default
    return msgspec.NODEFAULT if field.required else field.default_factory()


def _struct_in(kind: kinds.Type) -> type[msgspec.Struct] | None:
    """Returns the struct type of a field: direct, optional, or per name; None for other types."""
    if isinstance(kind, kinds.StructType):
        return kind.cls
    if isinstance(kind, kinds.DictType):
        return _struct_in(kind.value_type)
    if isinstance(kind, kinds.UnionType):
        return next((found for inner in kind.types if (found := _struct_in(inner))), None)
    return None
