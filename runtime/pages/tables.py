"""Units, comments and Markdown tables for the pages that are generated from the code."""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterable
from functools import cache

UNITS = {  # by the suffix of a field name; longer suffixes first
    "_rad_per_sqrt_m": "rad/m^0.5",
    "_rel_per_sqrt_m": "fraction/m^0.5",
    "_rad_per_m": "rad/m",
    "_per_m": "1/m",
    "_mps2": "m/s2",
    "_radps2": "rad/s2",
    "_radps": "rad/s",
    "_mps": "m/s",
    "_m": "m",
    "_rad": "rad",
    "_px": "px",
    "_ns": "ns",
    "_ms": "ms",
    "_s": "s",
    "_hz": "Hz",
    "_rel": "fraction",
    "_bytes": "B",
    "_percent": "%",
    "_grey": "grey levels",
    "_sigma": "sigma",
}


def unit(name: str) -> str:
    """Returns the unit by the suffix of a field name, or ""."""
    return next((symbol for suffix, symbol in UNITS.items() if name.endswith(suffix)), "")


def comments(kind: type) -> dict[str, str]:
    """Returns field -> comment in the source: the comment on its line, or else those directly above it.

    Includes the fields of base classes; fields without a comment are missing.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if base.__module__.partition(".")[0] not in ("builtins", "enum", "msgspec"):
            found |= _own_comments(base)
    return found


def table(rows: Iterable[tuple[str, ...]]) -> str:
    """Returns a Markdown table; the first row is the head."""
    head, *body = rows
    lines = [head, ("---",) * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines)


@cache
def _own_comments(kind: type) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(kind))
    texts, alone = {}, set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            texts[token.start[0]] = token.string.lstrip("# ")
            if token.line.lstrip().startswith("#"):
                alone.add(token.start[0])
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node in tree.body:
        target = node.target if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [None])[0]
        if not isinstance(target, ast.Name):
            continue
        lines = [line for line in range(node.lineno, (node.end_lineno or node.lineno) + 1) if line in texts]
        if not lines:
            above = node.lineno - 1
            while above in alone:
                lines.insert(0, above)
                above -= 1
        if lines:
            found[target.id] = " ".join(texts[line] for line in lines)
    return found
