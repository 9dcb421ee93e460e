"""What a user installs, without the checkout: `make wheel-test`.

The wheel is built from the source distribution and installed, with the dependencies that it declares and nothing else,
into an empty environment in a folder of its own. There the shipped drive is run from it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FRAMES = 30
LIMIT_S = 600.0
FOLDERS = {
    "birdslam": "birdslam",
    "birdslam/runtime": "runtime",
    "birdslam/perf": "perf",
    "birdslam/deploy": "deploy",
    "birdslam/configs": "configs",
}
NOT_PACKED = {".md", ".png", ".pyc", ".nbi", ".nbc"}  # pages and pictures of perf/, caches


def call(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    """Runs a command; gives its standard output. Its failure ends the proof."""
    done = subprocess.run(
        command, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S
    )
    assert done.returncode == 0, f"{command[0]} has ended with {done.returncode}:\n{done.stdout}"
    return done.stdout


def build(folder: Path) -> Path:
    """The source distribution, and from it, not from the checkout, the wheel."""
    call(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder.parent)
    (wheel,) = folder.glob("birdslam-*.whl")
    return wheel


def packaged_files() -> set[str]:
    """The files of the checkout that the wheel contains, by their paths in site-packages."""
    found = set()
    for package, folder in FOLDERS.items():
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT / folder)
            packed = path.is_file() and (path.suffix not in NOT_PACKED or folder == "deploy")
            if packed and inside.parts[0] != "world" and "__pycache__" not in inside.parts:
                found.add(f"{package}/{inside.as_posix()}")
    return found


def check_contents(wheel: Path) -> None:
    """Every file of the package and its data, and nothing beside it in site-packages."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    _, version, *_ = wheel.name.split("-")
    assert {name.split("/")[0] for name in names} == {"birdslam", f"birdslam-{version}.dist-info"}
    packed, expected = {name for name in names if name.startswith("birdslam/")}, packaged_files()
    assert packed == expected, f"missing {sorted(expected - packed)}, too much {sorted(packed - expected)}"


def install(wheel: Path, environment: Path) -> Path:
    """Gives the folder of the environment's programs."""
    venv.create(environment, with_pip=False, symlinks=True)
    programs = environment / "bin"
    pip = (sys.executable, "-m", "pip", "--python", programs / "python", "--disable-pip-version-check")
    call(*pip, "install", "--quiet", "--no-compile", wheel, cwd=environment)
    return programs


def drive(birdslam: Sequence[str | Path], folder: Path, **environment: str) -> None:
    """The first frames of the shipped drive by this command, of which none may be lost."""
    folder.mkdir(exist_ok=True)
    said = call(
        *(*birdslam, "run", "--source", "demo", "--rate", "max", "--set", f"source.frames={FRAMES}"),
        *("--set", f"runtime.runtime_dir={folder / 'run'}", "--output", folder / "out"),
        *("--set", f"runtime.watchdog_ms={1e3 * LIMIT_S}"),  # a busy machine is no stalled node
        cwd=folder,
        env={"PATH": os.environ["PATH"], "HOME": str(folder), **environment},
    )
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["ended"] == "end of source", said
    assert summary["frames_in"] == summary["frames_processed"] == FRAMES, said
    assert summary["invalid_frames"] <= 5, said  # the first has no motion
    assert set(summary["models"]) == {"multitask"}, said
    assert 5.0 < summary["path_m"] < 20.0, said
    print("\n".join(line for line in said.splitlines() if not line.startswith(("frame ", "waiting"))))


def check_place(programs: Path) -> None:
    """The package that is imported is the installed one."""
    code = "import birdslam; print(birdslam.__file__)"
    where = call(programs / "python", "-P", "-c", code, cwd=programs, env={"PATH": os.environ["PATH"]})
    assert Path(where.strip()).is_relative_to(programs.parent), where


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="wheel-") as folder:
        place = Path(folder)
        wheel = build(place / "dist")
        check_contents(wheel)
        programs = install(wheel, place / "environment")
        check_place(programs)
        drive([programs / "birdslam"], place / "elsewhere")


if __name__ == "__main__":
    main()
