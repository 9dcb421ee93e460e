"""`birdslam batch`: drives a minute over workers, alone and on Ray, what Ray costs, and what many hours of video need.

    python -m perf batch [DRIVE ...] [--data DIR] [--frames N] [--workers 1,2] [--rounds N] [--output FILE.json]

Each cell drives all of them afresh. The engines take turns, so that a machine that others use slows both alike; the
cost of Ray is the median of the ratios of a round. A Ray cluster of this computer alone is started for each cell and is
no part of its time; without Ray (the extra `ray`) its cells are left out. What many hours need is computed from the
processor time and the memory of the plain engine's processes and from the bytes that they wrote.
"""

from __future__ import annotations

import contextlib
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from birdslam.perf.errors import PerfError
from birdslam.perf.processes import free_port
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.batch.drive import DRIVES
from birdslam.runtime.batch.drives import Task, find_drives, tasks
from birdslam.runtime.batch.local import run_local
from birdslam.runtime.batch.on_ray import run_ray

label = "drives a minute over workers, alone and on Ray, and what many hours of video need"

REAL = (
    "kitti_odometry/sequences/00",
    "kitti_odometry/sequences/01",
    "kitti_odometry/sequences/06",
    "kitti_tracking/training/image_03/0005",
)
HOURS = 10_000
RATES_HZ = (10.0, 33.0)  # of the video
START_FRAMES = 2  # of a drive that is little but its start
DRIVE_S = 600.0  # of a drive of those hours, for what the start of a process costs


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("batch", label)
    parser.add_argument("drives", nargs="*", help=f"(default: {', '.join(REAL)})")
    add_data(parser)
    parser.add_argument("--frames", type=int, default=30, help="of each drive (default: 30)")
    parser.add_argument("--workers", default="1,2", help="drives at once (default: 1,2)")
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args(arguments)
    engines = ["plain", "ray"] if find_spec("ray") else ["plain"]
    if len(engines) == 1:
        print("Ray is not installed (pip install 'birdslam[ray]'): its rows are left out")
    places = options.drives or [str(options.data / drive) for drive in REAL]
    rows: list[dict[str, Any]] = []
    drives = find_drives(places)
    todo, start = (tasks(drives, [{"source.frames": n}], None, {}, [], {}) for n in (options.frames, START_FRAMES))
    with Ledger(options.output, label, drives=places, frames=options.frames) as ledger:
        ledger.add("start of a process", f"{START_FRAMES} frames a drive", **(first := measure("plain", 1, start)))
        for number in range(options.rounds):
            for workers in map(int, options.workers.split(",")):
                for engine in engines if number % 2 == 0 else engines[::-1]:
                    row = measure(engine, workers, todo)
                    rows.append({"engine": engine, "workers": workers, "round": number, **row})
                    ledger.add(f"{number}: {engine:5} {workers} at once", row_text(rows[-1]), **rows[-1])
        for workers, ratio in ratios(rows).items():
            ledger.add(f"Ray's cost, {workers} at once", f"{ratio:.3f} of the plain time", ratio=ratio)
        for rate_hz in RATES_HZ:
            needed = need(rows, first, options.frames, rate_hz)
            ledger.add(f"{HOURS} h of video at {rate_hz:g} Hz", needs(needed), **needed)


def measure(engine: str, workers: int, todo: list[Task]) -> dict[str, Any]:
    """All drives once into a fresh folder: wall time, and of the plain engine processor time, memory and bytes."""
    with tempfile.TemporaryDirectory(prefix="perf") as folder, contextlib.ExitStack() as stack:
        output = Path(folder)
        address = stack.enter_context(cluster(workers)) if engine == "ray" else ""
        before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        events = run_ray(todo, output, workers, address) if engine == "ray" else run_local(todo, output, workers)
        for event in events:
            if event.failure is not None:
                raise PerfError(f"{event.task.name}: {event.failure.error}")
        wall_s = time.monotonic() - begun_s
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        row: dict[str, Any] = {"drives": len(todo), "wall_s": round(wall_s, 2)}
        row["drives_a_minute"] = round(60.0 * len(todo) / wall_s, 3)
        if engine == "plain":
            files = [path for path in (output / DRIVES).rglob("*") if path.is_file()]
            row["cpu_s"] = round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 2)
            row["peak_mb"] = round(after.ru_maxrss / 1024.0, 1)  # of the largest process so far
            row["bytes"] = sum(path.stat().st_size for path in files)
        else:
            row["idle_mb"] = _cluster_mb()
        return row


@contextlib.contextmanager
def cluster(cpus: int) -> Iterator[str]:
    """A Ray cluster of one node; gives its address. Raises PerfError where it does not start."""
    port = free_port()
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", f"--num-cpus={cpus}"]
    command += [f"--port={port}", "--node-ip-address=127.0.0.1", "--include-dashboard=false"]
    command += ["--disable-usage-stats", "--min-worker-port=0", "--max-worker-port=0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    try:
        output = ""
        for line in process.stdout:
            output += line
            if "Ray runtime started" in line:
                break
        else:
            raise PerfError(f"ray did not start: {output[-400:]}")
        yield f"127.0.0.1:{port}"
    finally:
        children = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        process.communicate()
        for child in psutil.wait_procs(children, timeout=30.0)[1]:
            child.kill()


def _cluster_mb() -> float:
    """What Ray's own processes hold beside the drives', when these are over: each page once."""
    held = 0
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # a worker that ends now
            held += child.memory_full_info().pss
    return round(held / 2**20, 1)


def ratios(rows: list[dict[str, Any]]) -> dict[int, float]:
    """Workers -> time on Ray over plain time: the median over the rounds; empty without Ray."""
    walls = {(row["round"], row["workers"], row["engine"]): row["wall_s"] for row in rows}
    found: dict[int, list[float]] = {}
    for number, workers, engine in walls:
        if engine == "ray":
            ratio = walls[number, workers, "ray"] / walls[number, workers, "plain"]
            found.setdefault(workers, []).append(ratio)
    return {workers: round(median(values), 4) for workers, values in found.items()}


def need(rows: list[dict[str, Any]], start: dict[str, Any], frames: int, rate_hz: float) -> dict[str, float]:
    """Of HOURS of video in drives of DRIVE_S, by the plain engine with one drive at once (fewest at once measured)."""
    fewest = min(row["workers"] for row in rows)
    plain = [row for row in rows if row["engine"] == "plain" and row["workers"] == fewest]
    start_s = start["cpu_s"] / start["drives"]
    frame_s = median((row["cpu_s"] / row["drives"] - start_s) / (frames - START_FRAMES) for row in plain)
    frame_bytes = median((row["bytes"] - start["bytes"]) / row["drives"] / (frames - START_FRAMES) for row in plain)
    drives = HOURS * 3600.0 / DRIVE_S
    core_hours = (drives * start_s + HOURS * 3600.0 * rate_hz * frame_s) / 3600.0
    return {
        "frame_cpu_s": round(frame_s, 4),
        "start_cpu_s": round(start_s, 2),
        "core_hours": round(core_hours),
        "core_hours_an_hour": round(core_hours / HOURS, 2),
        "results_gb": round(HOURS * 3600.0 * rate_hz * frame_bytes / 1e9, 1),
        "peak_mb": max(row["peak_mb"] for row in plain),
    }


def row_text(row: dict[str, Any]) -> str:
    """A row for a person."""
    more = f"  {row['cpu_s']:.1f} s of processor  {row['peak_mb']:.0f} MB" if "cpu_s" in row else ""
    ray = f"  Ray itself {row['idle_mb']:.0f} MB" if "idle_mb" in row else ""
    return f"{row['drives_a_minute']:7.2f} drives a minute  {row['wall_s']:.1f} s{more}{ray}"


def needs(needed: dict[str, float]) -> str:
    """What they need, for a person."""
    return (
        f"{needed['core_hours']:,.0f} core-hours ({needed['core_hours_an_hour']:.2f} an hour of video: "
        f"{1e3 * needed['frame_cpu_s']:.0f} ms a frame, {needed['start_cpu_s']:.1f} s a drive), "
        f"{needed['peak_mb']:.0f} MB a drive at work, {needed['results_gb']:,.0f} GB of results"
    )
