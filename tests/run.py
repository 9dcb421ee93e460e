"""`make test`: runs computing tests, then tests that start processes, and prints one summary line.

python -m tests.run                       # both parts; the second runs where the first has failed, too
python -m tests.run --cpus [NAME,...]     # the tests that compute, under the kernels of other processors: a table
python -m tests.run --sample              # of that two variants and the tests marked `numeric`: .ci/run
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tests.leftovers import end_with_this_process

ON_EACH_CHANGE = "not slow and not faults and not onroad"
COMPUTING = f"not processes and {ON_EACH_CHANGE}"
ON_EACH_CPU = "not processes and not faults and not onroad and (not slow or numeric)"  # with the statistics of starts
SAMPLE = ("Nehalem", "perturbed tracks 1")
# Kernels of OpenBLAS, OpenCV and numpy, and numbers of threads, that replace this processor's
VARIANTS: dict[str, dict[str, str]] = {
    "native": {},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "OpenCV without AVX-512": {"OPENCV_CPU_DISABLE": "AVX512-SKX"},
    "OpenCV without AVX2": {"OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2"},
    "numpy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
    "numpy without AVX2": {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"},
    "2 threads": {"OPENCV_FOR_THREADS_NUM": "2", "BIRDSLAM_TEST_THREADS": "2"},
}
PERTURBED: dict[str, dict[str, str]] = {
    f"perturbed tracks {seed}": {"BIRDSLAM_ROUNDING": str(seed)} for seed in range(1, 4)
}
ALL_VARIANTS = {**VARIANTS, **PERTURBED}
NO_TESTS = 5  # pytest's exit status


@dataclass
class Result:
    """What one run of pytest came to."""

    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    status: int = 0

    def __add__(self, other: Result) -> Result:
        return Result(
            self.passed + other.passed,
            self.failed + other.failed,
            self.skipped + other.skipped,
            self.seconds + other.seconds,
            self.status or other.status,
        )

    def __str__(self) -> str:
        text = f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped in {self.seconds:.0f} s"
        return text if self.failed or not self.status else f"{text}; pytest ended with status {self.status}"


def pytest(marks: str, jobs: int, environment: Mapping[str, str], arguments: Sequence[str] = ()) -> Result:
    """Runs the tests with these marks in so many processes."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-n", str(jobs), "--dist", "worksteal", "-m", marks]
        began = time.monotonic()
        done = subprocess.run(
            [*command, f"--junitxml={report}", *arguments], check=False, env={**os.environ, **environment}
        )
        seconds = time.monotonic() - began
        if done.returncode == NO_TESTS or not report.is_file():
            return Result(seconds=seconds, status=done.returncode)
        suite = next(iter(ET.parse(report).getroot()))
    count = {name: int(suite.attrib[name]) for name in ("tests", "failures", "errors", "skipped")}
    failed = count["failures"] + count["errors"]
    return Result(count["tests"] - failed - count["skipped"], failed, count["skipped"], seconds, done.returncode)


def kernels() -> str:
    """Which kernels the libraries use on this processor."""
    name = "unknown"
    for library in sorted((Path(np.__file__).parents[1] / "numpy.libs").glob("libscipy_openblas*")):
        function = getattr(ctypes.CDLL(str(library)), "scipy_openblas_get_corename64_", None)
        if function is not None:
            function.restype = ctypes.c_char_p
            name = function().decode()
    return f"OpenBLAS {name}; OpenCV {cv2.getCPUFeaturesLine().split('*')[-1].strip()}; {os.cpu_count()} cores"


def under_variants(names: Sequence[str], marks: str) -> int:
    """Prints a table of the variants; 1 where a test fails under any."""
    rows, cores = [], os.cpu_count() or 2
    for name in names:
        print(f"== {name}", flush=True)
        rows.append((name, pytest(marks, cores, ALL_VARIANTS[name])))
    print("\n| variant | passed | failed | seconds |\n|---|---|---|---|")
    for name, result in rows:
        print(f"| {name} | {result.passed} | {result.failed} | {result.seconds:.0f} |")
    return int(any(result.status for _, result in rows))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.run")
    parser.add_argument(
        "--cpus", nargs="?", const="", metavar="NAMES", help="variants with commas between them; none: all"
    )
    parser.add_argument("--sample", action="store_true", help="two variants, and the tests marked `numeric`")
    options = parser.parse_args()
    end_with_this_process()
    if options.sample:
        return under_variants(SAMPLE, f"numeric and {COMPUTING}")
    if options.cpus is not None:
        names = [name.strip() for name in options.cpus.split(",") if name.strip()] or list(ALL_VARIANTS)
        if unknown := [name for name in names if name not in ALL_VARIANTS]:
            parser.error(f"there is no variant {unknown[0]!r}; expected one of {', '.join(ALL_VARIANTS)}")
        return under_variants(names, ON_EACH_CPU)
    print(f"kernels: {kernels()}", flush=True)
    computing = pytest(COMPUTING, os.cpu_count() or 2, {})
    processes = pytest(f"processes and {ON_EACH_CHANGE}", 4, {})
    total = computing + processes
    print(f"make test: {total} (computing {computing.seconds:.0f} s, processes {processes.seconds:.0f} s)")
    return int(total.status != 0)


if __name__ == "__main__":
    sys.exit(main())
