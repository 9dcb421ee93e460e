"""Written pages: old exactly when the code or data that they measure has changed (docs/pages.json)."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from birdslam.bench.tracking.leave_one_out import LeftOut
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting import leave_one_out, measured, pages, results
from birdslam.perf.reporting.code_digest import WHOLE_BELOW, Code, files_digest
from birdslam.perf.reporting.measured import Measured

ROOT = Path(__file__).resolve().parent.parent
MODULES = {
    "main.py": (
        '"""The command."""\n'
        "import math\n"
        "from toy import tables\n"
        "from toy.parts import LIMIT_M, Filter\n\n\n"
        "def run(x: float) -> str:\n"
        '    """Runs it."""\n'
        "    from toy.late import late\n\n"
        "    # a reason\n"
        "    return tables.render(Filter(LIMIT_M).step(math.sin(late(x))), 'toy.node')\n"
    ),
    "__init__.py": "",
    "parts.py": (
        "LIMIT_M = 2.0\nOTHER_M = 3.0\n\n\n"
        "class Filter:\n    def __init__(self, limit_m: float) -> None:\n        self.limit_m = limit_m\n\n"
        "    def step(self, x: float) -> float:\n        return min(x, self.limit_m)\n\n\n"
        "def unused() -> float:\n    return OTHER_M\n\n\n"
        "def limit() -> float:\n    return 1.0\n\n\ndef hidden(xs: list[float]) -> float:\n"
        "    unused = max(limit for limit in xs)\n    return unused + limit()\n"
    ),
    "tables.py": "NAMES = {}\nNAMES['a'] = 1\n\n\ndef render(*x: object) -> str:\n    return f'{x[0]:.{2}f}'\n",
    "late.py": "from toy.deep import late as late\n",
    "deep.py": "from toy.parts import hidden\n\n\ndef late(x: float) -> float:\n    return hidden([x])\n",
    "node.py": "def answer() -> int:\n    return 1\n",
    "alone.py": "class Filter:\n    pass\n",
}


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    folder = tmp_path / "toy"
    folder.mkdir()
    for name, text in MODULES.items():
        (folder / name).write_text(text)
    return folder


def digest(folder: Path) -> str:
    return Code({"toy": folder}).digest(["toy.main.run"])


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("parts.py", "min(x", "max(x"),
        ("parts.py", "LIMIT_M = 2.0", "LIMIT_M = 2.5"),
        ("tables.py", "x[0]", "x[-1]"),
        ("tables.py", "NAMES['a'] = 1", "NAMES['a'] = 2"),  # executed by the import
        ("deep.py", "[x]", "[-x]"),  # handed on by another module, and imported in a function
        ("parts.py", "return 1.0", "return 2.0"),  # its name is hidden in a comprehension beside it
        ("node.py", "return 1", "return 2"),  # a process that is started by its module's name
        ("main.py", "LIMIT_M, Filter", "LIMIT_M\nfrom toy.alone import Filter"),
        ("main.py", "import math", "import cmath as math"),
        ("__init__.py", "", "print()\n"),
    ],
)
def test_another_definition_that_is_reached_makes_a_page_old(toy: Path, file: str, old: str, new: str) -> None:
    before = digest(toy)
    edit(toy / file, old, new)
    assert digest(toy) != before


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("main.py", "# a reason", "# another reason"),
        ("main.py", '"""Runs it."""', '"""Runs all of it."""'),
        ("main.py", '"""The command."""\n', ""),
        ("parts.py", "min(x, self.limit_m)", "min(\n            x,\n            self.limit_m,\n        )"),
        ("parts.py", "return OTHER_M", "return 2 * OTHER_M"),  # a variable has the name of this function
        ("parts.py", "OTHER_M = 3.0", "OTHER_M = 4.0"),
        ("alone.py", "pass", "limit = 3"),
        ("alone.py", "class", "print()\n\n\nclass"),
    ],
)
def test_words_and_what_is_not_reached_make_no_page_old(toy: Path, file: str, old: str, new: str) -> None:
    before = digest(toy)
    edit(toy / file, old, new)
    assert digest(toy) == before


def test_a_definition_may_move_and_a_module_be_renamed(toy: Path) -> None:
    before = digest(toy)
    (toy / "deep.py").rename(toy / "deeper.py")
    edit(toy / "late.py", "toy.deep", "toy.deeper")
    assert digest(toy) == before


def test_a_digest_is_of_the_code_and_not_of_its_place(toy: Path, tmp_path: Path) -> None:
    there = shutil.copytree(toy, tmp_path / "elsewhere")
    for path in there.iterdir():
        os.utime(path, (0, 0))
    assert digest(there) == digest(toy)


@pytest.mark.parametrize("root", ["toy.main.go", "toy.gone.run", "elsewhere.run"])
def test_a_root_that_is_not_there_is_named(toy: Path, root: str) -> None:
    with pytest.raises(PerfError, match=root):
        Code({"toy": toy}).digest([root])


def test_data_are_names_sizes_and_small_files(tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    (drive / "images").mkdir(parents=True)
    (drive / "images" / "0.png").write_bytes(b"a" * (WHOLE_BELOW + 1))
    (drive / "times.txt").write_text("0.0\n")

    def found() -> str | None:
        return files_digest({"drive": drive})

    first = found()
    os.utime(drive / "times.txt", (0, 0))
    assert found() == first == files_digest({"drive": shutil.copytree(drive, tmp_path / "copy")})
    (drive / "images" / "0.png").write_bytes(b"b" * (WHOLE_BELOW + 1))
    assert found() == first
    assert files_digest({"drive": drive}, None) != files_digest({"drive": tmp_path / "copy"}, None)
    (drive / "times.txt").write_text("0.1\n")
    second = found()
    (drive / "images" / "0.png").write_bytes(b"b" * (WHOLE_BELOW + 2))
    third = found()
    (drive / "images" / "0.png").rename(drive / "images" / "1.png")
    assert len({first, second, third, found()}) == 4
    assert files_digest({"drive": drive, "gone": tmp_path / "gone"}) is None


# --- a page and what is kept of it ---

COMMAND = "python -c pass {data}/drive"


@pytest.fixture
def page(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> pages.Page:
    """A page of the toy in a checkout of its own, measured with what is there."""
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(measured, "FILE", tmp_path / "docs" / "pages.json")
    for made_of_others in (results, leave_one_out):
        monkeypatch.setattr(made_of_others, "texts", dict)
    monkeypatch.setenv("BIRDSLAM_DATA", str(tmp_path / "data"))
    for folder in ("data", "ships", "docs"):
        (tmp_path / folder).mkdir()
    (tmp_path / "data" / "drive").write_text("a drive")
    (tmp_path / "ships" / "weights").write_text("weights")
    measured.save({})
    monkeypatch.setattr(pages, "checkout", lambda: Code({"toy": toy}))
    return pages.Page("toy", (COMMAND,), {"docs/toy.md": ("toy.md", None)}, ("toy.main.run",), ("ships",))


def kept(page: pages.Page) -> dict[str, Measured]:
    code, data = pages.digests(page, pages.checkout())
    assert data is not None
    return {page.name: measured.now(code, data, 3.0)}


def test_a_page_is_fresh_until_code_files_or_data_are_others(page: pages.Page, toy: Path, tmp_path: Path) -> None:
    now = kept(page)

    def state(page: pages.Page = page) -> str:
        return pages.state(page, now, pages.checkout())

    assert state() == "fresh"
    assert pages.state(page, {}, pages.checkout()) == "old: never measured"
    (tmp_path / "data" / "drive").write_text("another")
    assert state() == "old: data"
    (tmp_path / "ships" / "weights").write_text("others")
    assert state() == "old: code, data"
    (tmp_path / "ships" / "weights").write_text("weights")
    (tmp_path / "data" / "drive").unlink()
    assert state() == "fresh; its data is not here"
    edit(toy / "parts.py", "min(x", "max(x")
    assert state() == "old: code"
    edit(toy / "parts.py", "max(x", "min(x")
    other = pages.Page("toy", (f"{COMMAND} --seeds 2",), page.made, page.code, page.ships)
    assert state(other) == "old: code"
    now["toy"] = replace(now["toy"], versions=now["toy"].versions | {"numpy": "1.0"})
    assert state() == "fresh; its data is not here; numpy 1.0 then"


def test_a_page_that_is_made_of_the_code_is_old_where_its_text_differs(page: pages.Page, tmp_path: Path) -> None:
    derived = pages.Derived("made", "birdslam made", lambda: {"docs/made.md": "now\n"})
    (tmp_path / "docs" / "made.md").write_text("then\n")
    assert pages.state(derived, {}, pages.checkout()) == "old: docs/made.md"
    pages.write(derived, pages.checkout())
    assert pages.state(derived, {}, pages.checkout()) == "fresh"


@pytest.mark.processes
def test_what_is_old_is_written_the_quickest_first_and_after_a_failure_the_others(
    page: pages.Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def of(name: str, program: str) -> pages.Page:
        return pages.Page(name, (program,), {f"docs/{name}.md": ("", None)}, page.code)

    program = "python -c \"from pathlib import Path; Path('docs/{0}.md').write_text('# {0}')\""
    names = ("slow", "quick", "unknown")
    table = [*(of(name, program.format(name)) for name in names), of("failing", "python -c 'raise SystemExit(3)'")]
    table.append(of("fresh", "python -c pass"))
    monkeypatch.setattr(pages, "PAGES", tuple(table))
    took_s = {"slow": 90.0, "quick": 2.0, "failing": 1.0}
    before = {name: Measured(date="2026-11-20", commit="0" * 12, takes_s=s) for name, s in took_s.items()}
    measured.save(before | {name: now for page in table[-1:] for name, now in kept(page).items()})

    assert pages.run(["--write", "--only-quick"]) == 1
    assert re.findall(r"^--- (\w+)", capsys.readouterr().out, re.MULTILINE) == ["failing", "quick"]
    assert pages.run(["--write"]) == 1
    printed = capsys.readouterr().out
    assert re.findall(r"^--- (\w+)", printed, re.MULTILINE) == ["failing", "slow", "unknown"]
    assert printed.splitlines()[-1].startswith("failing failed: PerfError: status 3 of python -c")
    found = measured.load()
    assert found["failing"] == before["failing"]
    for name in names:
        assert pages.state(table[names.index(name)], found, pages.checkout()) == "fresh"
        assert (tmp_path / "docs" / f"{name}.md").read_text() == f"# {name}\n\n{measured.stamp(name, found[name])}\n"
    assert pages.run(["--write", "failing"]) == 1
    assert pages.run([]) == 0


def test_a_stamp_takes_the_place_of_the_last(page: pages.Page) -> None:
    now = kept(page)["toy"]
    text = measured.stamped("# Toy\n\nFigures.\n", "toy", now)
    assert text == f"# Toy\n\nFigures.\n\n{measured.stamp('toy', now)}\n"
    later = replace(now, date="2027-01-01")
    assert measured.stamped(text, "toy", later) == f"# Toy\n\nFigures.\n\n{measured.stamp('toy', later)}\n"


# --- the pages of this checkout ---

MEASURED = [page for page in pages.PAGES if isinstance(page, pages.Page)]


def test_the_table_of_what_other_sequences_choose_is_the_reports() -> None:
    (text,) = leave_one_out.texts().values()
    assert text == (ROOT / "docs" / "constants.md").read_text(), "python -m perf pages --write constants"
    kept = msgspec.json.decode((ROOT / leave_one_out.KEPT).read_bytes(), type=list[leave_one_out.Row])
    assert [row.key for row in kept] == [f"slam.frontend.{key}" for key in leave_one_out.TRIED]


def test_what_other_sequences_choose_is_summed_up() -> None:
    def row(sequence: str, chosen: str, score: float) -> LeftOut:
        return LeftOut(
            **{"key": "key", "sequence": sequence, "as_it_is": "1.0", "chosen": chosen, "score_as_it_is": -1.0},
            **{"score_chosen": score, "depth_error_as_it_is_rel": 0.03, "depth_error_chosen_rel": 0.03 - 0.01 * score},
        )

    rows = [row("a", "1.0", -1.0), row("b", "2.0", -1.2), row("c", "2.0", -0.5)]
    (found,) = msgspec.json.decode(leave_one_out.kept(msgspec.json.encode(rows).decode()), type=list[leave_one_out.Row])
    assert (found.key, found.as_it_is, found.chosen) == ("key", "1.0", {"2.0": 2, "1.0": 1})
    assert (found.better, found.worse, found.score_as_it_is, found.score_chosen) == (1, 1, -1.0, -0.9)
    assert (found.depth_error_as_it_is_rel, found.depth_error_chosen_rel) == (0.03, 0.039)


def test_every_measured_page_is_kept_with_its_figures() -> None:
    assert {page.name for page in MEASURED} == measured.load().keys()
    files = [file for page in pages.PAGES for file in page.files]
    assert sorted(files) == sorted(set(files))
    docs = {f"docs/{path.relative_to(ROOT / 'docs')}" for path in (ROOT / "docs").rglob("*")}
    written = {path for path in docs if path.endswith((".png", ".jpg", ".csv", ".json")) and "/examples/" not in path}
    assert written - {"docs/pages.json"} <= set(files)
    assert all((ROOT / file).is_file() for file in files)


def test_a_measured_page_says_with_what_it_was_measured() -> None:
    found = measured.load()
    for page in MEASURED:
        for file in page.files:
            if file.endswith(".md"):
                last = (ROOT / file).read_text().rstrip("\n").splitlines()[-1]
                assert last == measured.stamp(page.name, found[page.name]), f"python -m perf pages --write {page.name}"


def test_no_page_that_takes_less_than_a_minute_is_old() -> None:
    code, found = pages.checkout(), measured.load()
    states = {page.name: pages.state(page, found, code) for page in MEASURED}  # each root and file is there
    quick = [name for name in states if (found[name].takes_s or pages.QUICK_S) < pages.QUICK_S]
    old = [name for name in quick if pages.is_old(states[name])]
    assert not old, f"python -m perf pages --write {' '.join(old)}"
