"""A digest of what a figure was computed by: the definitions that its command reaches, and the files that these read.

From a function on, every definition that it names is followed through the imports, as `ast` sees them; a class counts
as a whole, and so does a module that is used as a value or named in a string (as processes are started). What is
digested is the syntax tree without docstrings, comments, layout and module names: rewording, formatting or moving a
definition changes nothing, and neither does the machine or the version of Python.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.machine import ROOT

DIGITS = 10  # of a digest, as it is shown and kept
WHOLE_BELOW = 64 << 10  # bytes: of larger files of data name and size are digested
_LOADED, _WHOLE = "<import>", "<all>"  # of a module: what its import executes, and everything
_NO_MEANING = {"ctx", "kind", "type_comment"}
_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
_DEFINES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


@dataclass(frozen=True)
class Definition:
    """A statement of a module: what of it is digested, and the full names that it uses."""

    said: str
    uses: frozenset[str]


@dataclass
class Module:
    """What a file defines by name, what it imports (name -> full name), and its statements that define nothing."""

    definitions: dict[str, list[Definition]] = field(default_factory=dict)
    imports: dict[str, str] = field(default_factory=dict)
    effects: list[Definition] = field(default_factory=list)


class Code:
    """The modules of some packages, read when they are reached."""

    def __init__(self, packages: Mapping[str, Path]) -> None:
        """`packages`: the name of each with its folder; links in it are not followed."""
        self._files: dict[str, Path] = {}
        for name, folder in packages.items():
            for path in folder.rglob("*.py"):
                parts = path.relative_to(folder).with_suffix("").parts
                self._files[".".join((name, *parts)).removesuffix(".__init__")] = path
        self._modules: dict[str, Module] = {}
        self._places: dict[str, tuple[str, str]] = {}

    def digest(self, roots: Iterable[str], more: Iterable[str] = ()) -> str:
        """Of all that these functions, classes or modules (full names) reach, and of `more`. Raises PerfError for a
        name that is not there."""
        said = {definition.said for definition in self._reached(roots) if definition.said}
        return _short((*sorted(said), *more))

    def _reached(self, roots: Iterable[str]) -> Iterator[Definition]:
        todo = list(roots)
        for root in todo:
            module, name = self._split(root)
            if not module or (name and name not in self._module(module).definitions):
                raise PerfError(f"there is no {root} in the code")
        seen: set[tuple[str, str]] = set()
        while todo:
            module, name = self._split(todo.pop())
            for part in (_LOADED, name or _WHOLE) if module else ():
                if (module, part) not in seen:
                    seen.add((module, part))
                    for definition in self._part(module, part):
                        todo += definition.uses
                        yield definition

    def _part(self, module: str, part: str) -> list[Definition]:
        content = self._module(module)
        if part == _LOADED:
            return self._loaded(module)
        if part == _WHOLE:
            return [one for many in content.definitions.values() for one in many]
        if part in content.definitions:
            return content.definitions[part]
        # Handed on from where it was imported, or made while it runs: then all of the module
        return [Definition("", frozenset({content.imports.get(part, module)}))]

    def _loaded(self, module: str) -> list[Definition]:
        """What the import of a module executes: its own statements, and those of the packages that it lies in."""
        parts = module.split(".")
        names = (".".join(parts[:end]) for end in range(1, len(parts) + 1))
        return [effect for name in names if name in self._files for effect in self._module(name).effects]

    def _split(self, full: str) -> tuple[str, str]:
        """The module and the name in it, "" for all of it; ("", "") for code that is not ours."""
        if full not in self._places:
            self._places[full] = self._place(full)
        return self._places[full]

    def _place(self, full: str) -> tuple[str, str]:
        parts = full.split(".")
        for end in range(len(parts), 0, -1):
            if (module := ".".join(parts[:end])) in self._files:
                return module, parts[end] if end < len(parts) else ""
        return "", ""

    def _module(self, name: str) -> Module:
        if name not in self._modules:
            self._modules[name] = _read(name, ast.parse(self._files[name].read_text(encoding="utf-8")), self._files)
        return self._modules[name]


def checkout() -> Code:
    """The code as it lies here."""
    folders = {"birdslam": "birdslam", "birdslam.runtime": "runtime", "birdslam.perf": "perf", "tests": "tests"}
    return Code({name: ROOT / folder for name, folder in folders.items()})


def _read(name: str, tree: ast.Module, known: Mapping[str, Path]) -> Module:
    module = Module()
    statements = [node for node in tree.body if not _is_text(node) and not _is_main_guard(node)]
    bound = [(node, _binds(node)) for node in statements]
    for node in statements:
        if not isinstance(node, _DEFINES):  # also of `try` and `if TYPE_CHECKING`
            module.imports |= _imports(node)
    own = {each: f"{name}.{each}" for _, names in bound for each in names if each not in module.imports}
    outside, tops = own | module.imports, {each.partition(".")[0] for each in known}
    for node, names in bound:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            continue
        uses = frozenset(_uses(node, outside | _imports(node), known))
        others = sorted(each for each in uses if each.partition(".")[0] not in tops)  # of other libraries
        definition = Definition(f"{_form(node)} {' '.join(others)}", uses)
        for each in names - module.imports.keys():
            module.definitions.setdefault(each, []).append(definition)
        if not names:
            module.effects.append(definition)
    return module


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _is_main_guard(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'"


def _binds(node: ast.AST) -> set[str]:
    """The names that a statement gives a value, not within functions and classes."""
    if isinstance(node, _DEFINES):
        return {node.name}
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return set(_imports(node))
    if isinstance(node, ast.Name):
        return {node.id} if isinstance(node.ctx, ast.Store) else set()
    if isinstance(node, _COMPREHENSIONS):  # a scope of its own, but for `:=`
        return {name for each in ast.walk(node) if isinstance(each, ast.NamedExpr) for name in _binds(each.target)}
    return {name for child in ast.iter_child_nodes(node) for name in _binds(child)}


def _imports(node: ast.AST) -> dict[str, str]:
    """Name -> full name, of every import in it."""
    found: dict[str, str] = {}
    for each in ast.walk(node):
        if isinstance(each, ast.ImportFrom):
            found |= {alias.asname or alias.name: f"{each.module}.{alias.name}" for alias in each.names}
        elif isinstance(each, ast.Import):
            top = {alias: alias.name if alias.asname else alias.name.partition(".")[0] for alias in each.names}
            found |= {alias.asname or full: full for alias, full in top.items()}
    return found


def _uses(node: ast.AST, names: Mapping[str, str], known: Mapping[str, Path]) -> Iterator[str]:
    """Full names, with the attributes that follow them: `tables.render` of an imported module is its `render`."""
    attributes: list[str] = []
    inner = node
    while isinstance(inner, ast.Attribute):
        attributes.append(inner.attr)
        inner = inner.value
    if isinstance(inner, ast.Name):
        if inner.id in names and isinstance(inner.ctx, ast.Load):
            yield ".".join((names[inner.id], *reversed(attributes)))
    elif isinstance(inner, ast.Constant):
        if isinstance(inner.value, str) and inner.value in known:  # of a process that is started
            yield inner.value
    else:
        own = _own_names(inner)
        inside = {name: full for name, full in names.items() if name not in own} if own else names
        for field_name, value in ast.iter_fields(inner):
            for child in value if isinstance(value, list) else (value,):
                if isinstance(child, ast.AST) and not _is_silent(child):
                    outside = field_name in ("args", "decorator_list", "returns")  # of a function
                    yield from _uses(child, names if outside else inside, known)


def _own_names(node: ast.AST) -> set[str]:
    """The names that hide those of the module within a function or a comprehension."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        body = node.body if isinstance(node.body, list) else [node.body]
        theirs = {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
        theirs |= {name for statement in body for name in _binds(statement)}
        shared = {name for each in ast.walk(node) if isinstance(each, ast.Global) for name in each.names}
        return theirs - shared - _imports(node).keys()
    if isinstance(node, _COMPREHENSIONS):
        return {name for each in node.generators for name in _binds(each.target)}
    return set()


def _form(value: object) -> str:
    """The syntax tree as text, without empty fields, so that every version of Python gives the same."""
    if isinstance(value, ast.JoinedStr):
        return f"JoinedStr({_form([part for part in value.values if not _is_empty(part)])})"
    if isinstance(value, ast.AST):
        named = ((name, inner) for name, inner in ast.iter_fields(value) if name not in _NO_MEANING)
        parts = (f"{name}={_form(inner)}" for name, inner in named if inner not in (None, []))
        return f"{type(value).__name__}({','.join(parts)})"
    if isinstance(value, list):
        return f"[{','.join(_form(item) for item in value if not _is_silent(item))}]"
    return repr(value)


def _is_silent(value: object) -> bool:
    """A docstring, or an import, whose names count where they are used."""
    return isinstance(value, (ast.Import, ast.ImportFrom)) or (isinstance(value, ast.stmt) and _is_text(value))


def _is_empty(value: ast.expr) -> bool:
    """What Python 3.12 has behind the last value of a format."""
    return isinstance(value, ast.Constant) and value.value == ""


# --- files ---


def files_digest(files: Mapping[str, Path], whole_below: int | None = WHOLE_BELOW) -> str | None:
    """Of files and folders, by the names that they go by: names, sizes, and what is in small ones (None: in all). None
    where one is not there."""
    said = []
    for name, top in files.items():
        if not top.exists():
            return None
        for path in sorted(path for path in (top, *top.rglob("*")) if path.is_file()):
            size = path.stat().st_size
            text = path.read_bytes() if whole_below is None or size <= whole_below else b""
            said.append(f"{name}/{path.relative_to(top).as_posix()} {size} {hashlib.sha256(text).hexdigest()}")
    return _short(sorted(said))


def _short(said: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(said).encode()).hexdigest()[:DIGITS]
