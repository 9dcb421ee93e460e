"""Style of texts: words and names that CONTRIBUTING.md's style guide replaces must not appear."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CODE = sorted(path for folder in ("birdslam", "runtime", "perf") for path in (ROOT / folder).rglob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Phrase -> what to write instead
PHRASES = {
    r"\banew\b": "again, restart",
    r"\bonce more\b": "again",
    r"\bso many times\b": "the count, the factor",
    r"\b(is|are|was|were|be) told\b": "is reported, estimated, known",
    r"\bchose nothing\b": "held out",
    r"\bwhat chose\b": "the data that tuned",
    r"\bchosen on\b": "tuned on",
    r"\bnobody knows\b": "has no metric position",
    r"\bthat is none\b": "is not a ...",
    r"\bhas its say\b": "is used",
    r"\bwho (stands|drives|walks)\b": "stationary, moving, walking",
    r"\bunit of length\b": "scale",
    r"\bby so much\b": "by this amount",
    r"\bin plain words\b": "(leave out)",
}
NAMES = {
    r"^_?(LEAST|MOST|SELDOM|AMPLE)_": "MIN_, MAX_, an interval or a count",
    r"^_?(lose_way|give_way|gives_way|hear|ask_aside)$": "a verb phrase without a metaphor",
    r"^_?(told|begun)$": "reported, started",
}


def tokens(path: Path) -> Iterator[tokenize.TokenInfo]:
    with io.BytesIO(path.read_bytes()) as file:
        yield from tokenize.tokenize(file.readline)


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Line number and text of every comment and string of a module."""
    for token in tokens(path):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            yield from enumerate(token.string.splitlines(), token.start[0])


def identifiers(path: Path) -> Iterator[tuple[int, str]]:
    """The names that a module binds, by line; a name that is only used is bound somewhere else."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def findings(path: Path, lines: Iterator[tuple[int, str]], patterns: dict[str, str]) -> list[str]:
    anywhere = "|".join(patterns).replace("^", r"\b").replace("$", r"\b")
    if not re.search(anywhere, path.read_text(), re.I):  # quicker than a parser
        return []
    return [
        f"{path.relative_to(ROOT)}:{number}: {found.group()!r}, write {instead}"
        for number, line in lines
        for pattern, instead in patterns.items()
        if (found := re.search(pattern, line, re.I if patterns is PHRASES else 0))
    ]


def test_pages_use_standard_terms() -> None:
    wrong = [one for path in PAGES for one in findings(path, enumerate(path.read_text().splitlines(), 1), PHRASES)]
    assert not wrong, "\n".join(wrong)


def test_comments_and_messages_use_standard_terms() -> None:
    wrong = [one for path in CODE for one in findings(path, texts(path), PHRASES)]
    assert not wrong, "\n".join(wrong)


def test_names_use_standard_terms() -> None:
    wrong = sorted({one for path in CODE for one in findings(path, identifiers(path), NAMES)})
    assert not wrong, "\n".join(wrong)


def test_check_finds_known_violations(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('LEAST_M = 1.0  # begins anew\n"""Who stands is told."""\n')
    assert [number for number, line in texts(module) if any(re.search(p, line, re.I) for p in PHRASES)] == [1, 2]
    assert [name for _, name in identifiers(module) if any(re.search(p, name) for p in NAMES)] == ["LEAST_M"]


@pytest.mark.processes
def test_codespell_finds_nothing() -> None:
    pytest.importorskip("codespell_lib")
    done = subprocess.run(
        [sys.executable, "-m", "codespell_lib", "birdslam", "runtime", "perf", "tests", "docs", "deploy", *PAGES[:3]],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
