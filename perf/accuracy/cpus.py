"""Spread of results between processors: the same evaluations with the kernels of other CPUs.

    python -m perf cpus [--data DIR] [--variant NAME ...] [--output DIR]

Libraries select kernels by processor; the environment variables in VARIANTS select those of another one. The command
prints the README's results (ego-motion, positions of cars) for each variant, and their spread.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from birdslam.bench.figures import markdown
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import birdslam_command
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "the README's results with the kernels of other processors, and their spread"

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
SEQUENCES = ("kitti_odometry/sequences/00", "kitti_odometry/sequences/01", "kitti_odometry/sequences/06")
TRACKING, CARS_IN = "kitti_tracking/training", "0005"


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("cpus", label, output="folder of cpus.json")
    add_data(parser)
    parser.add_argument("--variant", nargs="+", metavar="NAME", help=f"of {', '.join(VARIANTS)}; default: all")
    options = parser.parse_args(arguments)
    names = options.variant or list(VARIANTS)
    if unknown := [name for name in names if name not in VARIANTS]:
        raise PerfError(f"--variant {unknown[0]}: expected one of {', '.join(VARIANTS)}")
    missing = [name for name in (*SEQUENCES, TRACKING) if not (options.data / name).is_dir()]
    path = None if options.output is None else options.output / "cpus.json"
    found: dict[str, dict[str, float]] = {}
    with Ledger(path, label) as ledger:
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                found[name] = dict(_figures(options.data, Path(folder), VARIANTS[name], bool(missing)))
            ledger.add(name, ", ".join(f"{key} {value:.4g}" for key, value in found[name].items()), **found[name])
    print(_table(found))
    if missing:
        print(f"missing in {options.data}: {', '.join(missing)}")


def _figures(data: Path, folder: Path, environment: Mapping[str, str], demo_alone: bool) -> Iterator[tuple[str, float]]:
    """The README's results by name, for odometry without networks and for recorded boxes."""
    sequences = ["demo"] if demo_alone else ["demo", *(str(data / name) for name in SEQUENCES)]
    _evaluate(environment, "odometry", *sequences, "--output", str(folder / "odometry"))
    for row in json.loads((folder / "odometry" / "report.json").read_bytes()):
        yield f"{row['sequence']} ATE m", row["ate_m"]
        yield f"{row['sequence']} scale %", 100.0 * row["scale_error"]
    if demo_alone:
        return
    cars = ("localisation", str(data / TRACKING), "--sequences", CARS_IN)
    _evaluate(environment, *cars, "--output", str(folder / "cars"))
    for row in json.loads((folder / "cars" / "report.json").read_bytes()):
        if row["sequence"] == "all" and row["depth_error_median_rel"] is not None:
            yield f"depth {row['range']} %", 100.0 * row["depth_error_median_rel"]


def _evaluate(environment: Mapping[str, str], *arguments: str) -> None:
    """Runs `birdslam evaluate`. Raises PerfError with its message if it fails."""
    command = birdslam_command("evaluate", *arguments)
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **environment})
    if done.returncode:
        raise PerfError(done.stderr.strip())


def _table(found: Mapping[str, Mapping[str, float]]) -> str:
    """A row for each result: its minimum and maximum over the variants."""
    keys = list(next(iter(found.values())))
    rows = []
    for key in keys:
        values = [figures[key] for figures in found.values()]
        rows.append((key, f"{min(values):.4g}", f"{max(values):.4g}", f"{max(values) - min(values):.2g}"))
    return markdown(("figure", "least", "greatest", "spread"), rows)
