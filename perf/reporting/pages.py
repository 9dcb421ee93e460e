"""Every page, table and picture that a command writes: which are older than what they measure, and those anew.

    python -m perf pages                           # `make pages`: page, old or fresh, age, how long it takes, command
    python -m perf pages --write [NAME ...]        # those that are old, or these; the quickest first
    python -m perf pages --write --only-quick      # of those that take less than a minute

A page is old once code, shipped file, command or recording differ from those it was written with (docs/pages.json).
"""

from __future__ import annotations

import datetime
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from birdslam.bench.tracking.by_class import people_page
from birdslam.perf.__main__ import benchmark_modules
from birdslam.perf.accuracy import films, overlays, tilt
from birdslam.perf.browser import gallery
from birdslam.perf.cameras import lens
from birdslam.perf.errors import PerfError
from birdslam.perf.graph import agents, edges, edges_table
from birdslam.perf.maps import loops
from birdslam.perf.perception import providers
from birdslam.perf.reporting import all as everything
from birdslam.perf.reporting import foxglove, leave_one_out, measured, results
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.code_digest import Code, checkout, files_digest
from birdslam.perf.reporting.machine import ROOT, describe
from birdslam.perf.reporting.measured import Measured
from birdslam.perf.robustness import faults
from birdslam.runtime.batch import batch
from birdslam.runtime.batch import report as batch_report
from birdslam.runtime.cli.evaluate import tracking as tracking_command
from birdslam.runtime.evaluation import lanes, localisation, odometry, tracking
from birdslam.runtime.pages import configuration, interface, sources

label = "which pages are older than what they measure; --write measures those anew"

QUICK_S = 60.0  # a test fails for a page that is old and takes less
NETWORKS = ("birdslam/perception/shipped", "birdslam/perception/manifests")
SHIPPED = (*NETWORKS, "birdslam/sources/drives/shipped")
PUBLISHED = "birdslam/bench/tracking/published.toml"
EVALUATED: dict[str, tuple[Any, ...]] = {  # by the first word of `birdslam evaluate`
    "odometry": (odometry.evaluate_odometry,),
    "localisation": (localisation.evaluate_localisation,),
    "tracking": (tracking.jobs_of, tracking.run_jobs, tracking.write_report),
}
PROGRAMS = {"birdslam": ("-m", "birdslam.runtime.cli.main"), "python": ()}  # what Python is given for a first word
REPORT = ("report.md", "age.png", "optimizer.png", "stages.png", "transport.png", "vehicles.png")
DRIVES = " ".join(f"{{data}}/{each}" for each in (*everything.SEQUENCES, "kitti_odometry/sequences/01"))
FILMS_S = 4  # of each variant: ten minutes of one core in all
OVERLAYS = "drops rain drops_defocused"
Text = Callable[[str], str]


@dataclass(frozen=True)
class Derived:
    """A page that is made of the code, or of what others measured, in no time; tests hold its files to `texts`."""

    name: str
    command: str
    texts: Callable[[], Mapping[str, str]]  # file -> what is to stand in it

    @property
    def files(self) -> tuple[str, ...]:
        return tuple(self.texts())


@dataclass(frozen=True)
class Page:
    """A page that is measured. In commands {data} and {models} are folders beside the project, {out} the page's own."""

    name: str
    commands: tuple[str, ...]
    made: Mapping[str, tuple[str, Text | None]]  # file -> what of {out} it is ("": itself), and what is made of that
    code: tuple[Any, ...]  # functions, or full names, whose definitions decide its figures
    ships: tuple[str, ...] = ()  # files and folders of the checkout that decide them too

    @property
    def command(self) -> str:
        return " && ".join(self.commands)

    @property
    def files(self) -> tuple[str, ...]:
        return tuple(self.made)

    @property
    def reads(self) -> tuple[str, ...]:
        """Recordings and networks beside the project."""
        return tuple(sorted(set(re.findall(r"\{(?:data|models)\}(?:/[\w.]+)?", self.command))))


def _evaluations() -> Iterable[Page]:
    for name, evaluation in results.EVALUATIONS.items():
        what = evaluation.command.partition(" ")[0]
        made: dict[str, tuple[str, Text | None]] = {f"docs/results/{name}.json": ("report.json", evaluation.kept)}
        code: tuple[Any, ...] = (*EVALUATED[what], evaluation.keep)
        ships: tuple[str, ...] = NETWORKS if "{models}" in evaluation.command else ()
        if what == "tracking":
            made["docs/tables.md"] = ("report.md", results.tables_page)
            code += (f"{tracking_command.__name__}.SEEDS",)
            ships += (PUBLISHED,)
        elif what == "odometry":
            ships = SHIPPED
        yield Page(name, (f"birdslam evaluate {evaluation.command} --output {{out}}",), made, code, ships)


PAGES: tuple[Derived | Page, ...] = (
    Derived("interface", "birdslam interface", lambda: {"docs/interface.md": interface.page()}),
    Derived("configuration", "birdslam configuration", lambda: {"docs/configuration.md": configuration.page()}),
    Derived("sources", "birdslam sources", lambda: {"docs/sources.md": sources.page()}),
    Derived("results", "python -m perf results", results.texts),
    Derived("constants", "python -m perf pages --write constants", leave_one_out.texts),
    *_evaluations(),
    Page(
        "leave_one_out",
        (f"birdslam evaluate {results.PLACES} {leave_one_out.OPTIONS} --output {{out}}",),
        {leave_one_out.KEPT: ("leave_one_out.json", leave_one_out.kept)},
        (localisation.evaluate_left_out, leave_one_out.kept),
    ),
    *(
        Page(
            name,
            (f"birdslam evaluate localisation {results.TRACKING} --class {kind} --output {{out}}",),
            {f"docs/{name}.md": ("report.json", made)},
            (localisation.evaluate_people, made),
        )
        for name, kind, made in (
            ("people", "pedestrian", people_page.pedestrians),
            ("cyclists", "cyclist", people_page.cyclists),
        )
    ),
    Page(
        "lanes",
        ("birdslam evaluate lanes demo --frame 60 --output {out}",),
        {"docs/lanes.png": ("lanes_demo_60.png", None)},
        (lanes.draw_frame_lanes,),
        SHIPPED,
    ),
    Page(
        "lens",
        ("python -m birdslam.perf lens --data {data} --output {out}",),
        {"docs/lens.md": ("lens.md", None)},
        (lens.run,),
        ("tests/dashcams",),
    ),
    Page(
        "tilt",
        ("python -m birdslam.perf tilt --data {data} --output {out}/tilt.json",),
        {"docs/tilt.md": ("tilt.json", tilt.page)},
        (tilt.run, tilt.page),
        SHIPPED,
    ),
    Page(
        "loops",
        (
            "python -m birdslam.perf loops --part recorded loop alike scale gnss size --equal-houses 1000 "
            "--data {data} --output {out}/loops.json",
        ),
        {"docs/loops.md": ("loops.json", loops.page)},
        (loops.run, loops.page),
        SHIPPED,
    ),
    Page(
        "edges",
        (f"python -m birdslam.perf edges --data {{data}} --logs {{out}} {results.REAL} --output {{out}}/edges.json",),
        {"docs/edges.md": ("edges.json", edges_table.page)},
        (edges.run, edges_table.page),
        NETWORKS,
    ),
    Page(
        "agents",
        ("python -m birdslam.perf agents --output {out}",),
        {"docs/agents.md": ("agents.md", None), "docs/agents.png": ("agents.png", None)},
        (agents.run,),
    ),
    Page(
        "providers",
        (
            "python -m birdslam.perf networks --provider all --onnxruntime onnxruntime-openvino --models {models} "
            "--output {out}/providers.json",
        ),
        {"docs/providers.md": ("providers.json", providers.page)},
        (providers.measure, providers.page),
        NETWORKS,
    ),
    Page(
        "films",
        (
            f"python -m birdslam.perf films --part sizes --part noise --part starts --seconds {FILMS_S} "
            "--data {data} --output {out}",
        ),
        {"docs/films.md": ("films.md", None)},
        (films.run,),
        ("perf/film_cameras",),
    ),
    Page(
        "overlays",
        (f"python -m birdslam.perf overlays --kinds {OVERLAYS} --data {{data}} --output {{out}}/overlays.json",),
        {"docs/overlays.md": ("overlays.json", overlays.page)},
        (overlays.run, overlays.page),
    ),
    Page(
        "batch",
        (f"birdslam batch {DRIVES} {{data}}/kitti_tracking/training/image_03/0005 {results.REAL} --output {{out}}",),
        {"docs/batch.png": ("report.png", None), "docs/bev.png": ("drives/00/bev.png", None)},
        (batch.run_batch, batch_report.write_report),
        NETWORKS,
    ),
    Page(
        "foxglove",
        (
            # Three times slower than it was driven: at its own 33 Hz a busy machine drops most frames
            "birdslam run --source demo --rate 10 --record {out}/drive.mcap --record-images --output {out}/run",
            "python -m birdslam.perf foxglove {out}/drive.mcap --at 64.5 --output {out}/foxglove.jpg",
        ),
        {"docs/foxglove.jpg": ("foxglove.jpg", None)},
        (foxglove.run,),  # it shows the layout; what was driven is shown elsewhere
        (str(foxglove.LAYOUT),),
    ),
    Page(
        "gallery",
        ("python -m birdslam.perf gallery --output {out}",),
        {f"docs/gallery/{name}.jpg": (f"{name}.jpg", None) for name in gallery.PICTURES},
        (gallery.run,),  # it shows what a run leaves; what was driven is shown elsewhere
    ),
    Page(
        "faults",
        ("python -m birdslam.perf faults --models {models} --markdown {out}/faults.md",),
        {"docs/faults.md": ("faults.md", None)},
        (faults.run,),
        SHIPPED,
    ),
    Page(
        "report",
        ("python -m birdslam.perf all --output {out}",),
        {f"perf/results/{name}": (name, None) for name in REPORT},
        tuple(sorted(f"{benchmark_modules()[step.benchmark]}.run" for step in everything.STEPS)),
        SHIPPED,
    ),
    # What pyproject.toml asks for is held by tests/test_installs.py; the rest is the package index's
    Page("wheels", ("python -m tests.wheels",), {"docs/wheels.csv": ("", None)}, ("tests.wheels",)),
)


def run(arguments: list[str]) -> int:
    """Lists the pages, after writing what is asked for; 1 where that failed. Raises PerfError without a checkout."""
    parser = benchmark_parser("pages", label, output="")
    names = [page.name for page in PAGES]
    parser.add_argument("--write", nargs="*", metavar="NAME", choices=names, help="what is old, or these")
    parser.add_argument("--only-quick", action="store_true", help=f"what takes less than {QUICK_S:.0f} s")
    options = parser.parse_args(arguments)
    if not measured.FILE.is_file():
        raise PerfError(f"{measured.FILE} is not there: the pages are part of the checkout, and no wheel has them")
    kept, failed = measured.load(), []
    for page in sorted(_chosen(options.write, kept), key=lambda page: _takes_s(page, kept)):
        if options.only_quick and _takes_s(page, kept) >= QUICK_S:
            continue
        print(f"\n--- {page.name}: {', '.join(page.files)}", flush=True)
        try:
            write(page, checkout())
        except Exception as error:  # whatever it is, the others are measured
            failed.append(f"{page.name} failed: {type(error).__name__}: {error}")
            print(failed[-1], flush=True)
    print("\n".join((listing(), *failed)))
    return int(bool(failed))


def _chosen(names: list[str] | None, kept: Mapping[str, Measured]) -> list[Derived | Page]:
    """Those of these names; of none given (`[]`) those that are old."""
    if names == []:
        code = checkout()
        return [page for page in PAGES if is_old(state(page, kept, code))]
    return [page for page in PAGES if page.name in (names or ())]


def _takes_s(page: Derived | Page, kept: Mapping[str, Measured]) -> float:
    """When it was last written; infinite where that is unknown."""
    if isinstance(page, Derived):
        return 0.0
    last = kept[page.name].takes_s if page.name in kept else None
    return float("inf") if last is None else last


def digests(page: Page, code: Code) -> tuple[str, str | None]:
    """Of the code (with the command and the files that ship), and of recordings and networks, None where they are not
    here."""
    roots = [root if isinstance(root, str) else f"{root.__module__}.{root.__qualname__}" for root in page.code]
    ships = files_digest({name: ROOT / name for name in page.ships}, whole_below=None)
    if ships is None:
        raise PerfError(f"{page.name}: not all is there of {', '.join(page.ships)}")
    data = {name: ROOT / name.format(**_folders(page)) for name in page.reads}
    return code.digest(roots, (page.command, ships)), files_digest(data)


def _folders(page: Page) -> dict[str, str]:
    """What a command is run with, from the checkout's root: no page may contain that path."""
    data, models = (os.environ.get(f"BIRDSLAM_{name.upper()}") or f"../shared/{name}" for name in ("data", "models"))
    return {"data": data, "models": models, "out": f"out/pages/{page.name}"}


def state(page: Derived | Page, kept: Mapping[str, Measured], code: Code) -> str:
    """ "fresh" or "old", and why."""
    if isinstance(page, Derived):
        differ = [file for file, text in page.texts().items() if (ROOT / file).read_text(encoding="utf-8") != text]
        return f"old: {', '.join(differ)}" if differ else "fresh"
    if page.name not in kept:
        return "old: never measured"
    then = kept[page.name]
    code_now, data_now = digests(page, code)
    if then.code == measured.UNKNOWN:
        return "old: without a digest"
    changed = ["code"] * (then.code != code_now) + ["data"] * (data_now not in (None, then.data))
    if changed:
        return f"old: {', '.join(changed)}"
    versions = describe()["versions"]
    others = [f"{name} {version} then" for name, version in then.versions.items() if versions[name] != version]
    return "; ".join(("fresh", *(["its data is not here"] if data_now is None else []), *others))


def is_old(said: str) -> bool:
    return said.startswith("old")


def write(page: Derived | Page, code: Code) -> None:
    """Measures a page anew, and keeps with what; then the tables that are made of it. Raises PerfError, OSError."""
    if isinstance(page, Page):
        of_code, of_data = digests(page, code)
        if of_data is None:
            raise PerfError(f"not all is there of {', '.join(page.reads)} (BIRDSLAM_DATA, BIRDSLAM_MODELS)")
        begun_s = time.monotonic()
        _measure(page)
        now = measured.now(of_code, of_data, time.monotonic() - begun_s)
        for file in page.files:
            if file.endswith(".md"):
                (ROOT / file).write_text(measured.stamped((ROOT / file).read_text("utf-8"), page.name, now), "utf-8")
        measured.save(measured.load() | {page.name: now})
    for texts in (results.texts, leave_one_out.texts) if isinstance(page, Page) else (page.texts,):
        for file, text in texts().items():
            (ROOT / file).write_text(text, encoding="utf-8")


def _measure(page: Page) -> None:
    folders = _folders(page)
    out = ROOT / folders["out"]
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for command in page.commands:
        first, *words = shlex.split(command.format(**folders))
        status = subprocess.run([sys.executable, *PROGRAMS[first], *words], cwd=ROOT).returncode
        if status:
            raise PerfError(f"status {status} of {command}")
    for file, (source, change) in page.made.items():
        if change:
            (ROOT / file).write_text(change((out / source).read_text("utf-8")), encoding="utf-8")
        elif source:
            shutil.copyfile(out / source, ROOT / file)


def listing() -> str:
    """The table of all pages."""
    code, kept = checkout(), measured.load()
    rows = [("page", "files", "is", "age", "takes", "command")]
    for page in PAGES:
        last = None if isinstance(page, Derived) else kept.get(page.name)
        files = page.files[0] + (f" and {len(page.files) - 1} more" if len(page.files) > 1 else "")
        takes = "0 s" if isinstance(page, Derived) else measured.duration(last.takes_s if last else None)
        command = re.sub(r"\{(\w+)\}", lambda found: found[1].upper(), page.command)
        short = command if len(command) < 60 else f"{command[:56]} ..."
        rows.append((page.name, files, state(page, kept, code), _age(last) if last else "-", takes, short))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def _age(last: Measured) -> str:
    """In commits and days."""
    now = datetime.datetime.now(datetime.UTC).date()
    days = (now - datetime.date.fromisoformat(last.date)).days
    counting = ["git", "-C", str(ROOT), "rev-list", "--count", f"{last.commit.rstrip('+')}..HEAD"]
    try:
        counted = subprocess.run(counting, capture_output=True, text=True).stdout.strip()
    except OSError:
        counted = ""  # without git: by the date alone
    return f"{f'{counted} commits, ' if counted else ''}{days} days"
