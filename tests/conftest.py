"""Folders of real recordings and networks, profiles of property tests, and the processes that tests start.

`BIRDSLAM_DATA` and `BIRDSLAM_MODELS` name the folders of real recordings and networks; without them they lie in
../shared beside the project.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from birdslam.runtime.environment import ENVIRONMENT
from tests.leftovers import end_with_this_process

ROOT = Path(__file__).resolve().parent.parent

# One thread per library, as in the nodes, because tests run in parallel; set before any library is loaded
os.environ.update(ENVIRONMENT, OPENCV_FOR_THREADS_NUM="1")
if threads := os.environ.get("BIRDSLAM_TEST_THREADS"):  # a variant of `make test-cpus`
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    os.environ.update(dict.fromkeys(names, threads))

if seed := os.environ.get("BIRDSLAM_ROUNDING"):
    from tests.rounding import perturb_tracks

    perturb_tracks(int(seed))

# No time limits, since machines are shared. `make test` draws the same examples each time; `make test-slow` draws new
# ones by the profile "explore", and prints how to repeat one that fails.
settings.register_profile(
    "repeat",
    max_examples=30,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "explore", settings.get_profile("repeat"), derandomize=False, max_examples=1000, print_blob=True
)
settings.load_profile("repeat")


def _folder(variable: str, default: str) -> Path:
    folder = Path(os.environ.get(variable) or ROOT.parent / "shared" / default).expanduser().resolve()
    if not folder.is_dir():
        pytest.skip(f"no {default} at {folder} (set {variable})")
    return folder


@pytest.fixture(scope="session", autouse=True)
def small_pictures() -> None:
    """Draws pictures of drives with few pixels, which takes a quarter of the time."""
    from birdslam.outputs import bev_picture

    bev_picture.DPI = 40


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; skips the test if it is missing."""
    return _folder("BIRDSLAM_DATA", "data")


@pytest.fixture(scope="session")
def models_dir() -> Path:
    """The folder of real networks; skips the test if it is missing."""
    return _folder("BIRDSLAM_MODELS", "models")


@pytest.fixture
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A runtime directory with a short path, as sockets need it."""
    return tmp_path_factory.mktemp("run")


@pytest.fixture
def join(base: Path) -> Iterator[Any]:
    """join(node, ...) opens a Bus that is closed after the test; the first one is the hub."""
    from birdslam.runtime.transport.bus import Bus  # not before a test needs it: it loads zenoh

    with ExitStack() as stack:
        yield lambda node, **options: stack.enter_context(Bus("car", node, runtime_dir=base, **options))


gc.set_threshold(50_000, 20, 100)  # collections of millions of objects take a tenth of the time
end_with_this_process()
_may_start_processes = True


def _watch_processes(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "subprocess.Popen" and arguments[0] == sys.executable and not _may_start_processes:
        raise RuntimeError("a test that starts Python processes needs the marker `processes`")


sys.addaudithook(_watch_processes)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Only tests with the marker `processes` start any: the others compute, and fill a core each."""
    global _may_start_processes
    _may_start_processes = item.get_closest_marker("processes") is not None


def _starts_processes(file: Path) -> bool:
    return "mark.processes" in file.read_text(encoding="utf-8")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where only tests that start processes run, files without any are not loaded, in each of pytest's processes."""
    only = config.option.markexpr.startswith("processes") and collection_path.suffix == ".py"
    return True if only and not _starts_processes(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What that takes for granted: a file has the marker in its own text."""
    marked = {item.path for item in items if item.get_closest_marker("processes") is not None}
    if wrong := [path.name for path in marked if not _starts_processes(path)]:
        raise pytest.UsageError(f"the marker `processes` must stand in the file itself: {', '.join(wrong)}")
