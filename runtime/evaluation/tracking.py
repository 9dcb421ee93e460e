"""`birdslam evaluate tracking` and `birdslam evaluate ablation`: the paper's tables on KITTI tracking.

One process a sequence, each with everything that its sequence needs; the numbers come from birdslam/, the clock and the
files are here.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path

import msgspec

from birdslam.bench.tracking import tables
from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES
from birdslam.bench.tracking.picture import draw_runtime
from birdslam.bench.tracking.report import Outcome, Setting, render_report
from birdslam.outputs.drive_files import claim_directory
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.methods import METHODS
from birdslam.runtime.evaluation.tracking_job import Job, frames_to_make, run_sequence
from birdslam.runtime.options import speeds_of
from birdslam.runtime.process.workers import workers
from birdslam.runtime.progress import Progress, time_to_go
from birdslam.sources.kitti_tracking import camera_with_images
from birdslam.sources.recording import DatasetError

PUBLISHED = Path(tables.__file__).with_name("published.toml")


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """Both commands; gives the exit status."""
    jobs = _jobs(options, configuration)
    output = Path(options.output)
    claim_directory(output)
    outcomes = sorted(_run_all(jobs, max(1, options.jobs)), key=lambda o: (o.sequence, o.odometry == "images"))
    rows = [row for outcome in outcomes for row in outcome.rows]
    variants = [row for outcome in outcomes for row in outcome.ablation]
    job = jobs[0]
    ideas = [row for outcome in outcomes for row in outcome.ideas]
    if ideas:
        _write_json(output / "ideas.json", ideas)
    _write_json(output / "report.json", rows if job.methods else variants)
    if job.methods and variants:
        _write_json(output / "ablation.json", variants)
    told: list[msgspec.Struct] = [row for outcome in outcomes for row in (*outcome.ranges, *outcome.motion)]
    if told:
        _write_json(output / "told.json", told)
    longest = max(outcomes, key=lambda outcome: len(outcome.frames))
    draw_runtime(longest.updates_ms, output / "runtime.png")
    setting = Setting(job.frames, job.methods, max(job.seeds for job in jobs))
    report = render_report(setting, job.published, outcomes)
    (output / "report.md").write_text(report, encoding="utf-8")
    print(report)
    print(f"results in {output}")
    return 0


# --- what is asked for ---


def _jobs(options: argparse.Namespace, configuration: Configuration) -> list[Job]:
    root, published = options.root, tables.read_published(PUBLISHED)
    if not (root / "label_02").is_dir():
        raise DatasetError(f"{root}: is no KITTI tracking folder: it has no label_02")
    known = sorted(path.stem for path in (root / "label_02").glob("*.txt"))
    taken = [name for name in known if options.frames != "paper" or name in published.sequences]
    sequences = options.sequences.split(",") if options.sequences else taken
    missing = [name for name in sequences if name not in known]
    if missing or not sequences:
        raise ConfigurationError(f"--sequences: {root} has no {', '.join(missing) or 'sequences'}")
    if options.seeds < 1:
        raise ConfigurationError(f"--seeds {options.seeds}: needs 1 or more")
    compare = options.command == "evaluate tracking"
    chosen = tuple(options.methods.split(",")) if compare else ()
    unknown = [name for name in chosen if name not in METHODS]
    if unknown:
        raise ConfigurationError(f"--methods: there is no {', '.join(unknown)}; there are {', '.join(METHODS)}")
    jobs = [
        Job(
            root=root,
            sequence=name,
            frames=options.frames,
            methods=chosen,
            odometry=odometry,
            detections=detections,
            seeds=options.seeds if odometry == "simulate" else 1,
            ablate=own or not compare,
            output=Path(options.output),
            configuration=configuration,
            published=published,
        )
        for name in dict.fromkeys(sequences)
        for odometry, detections, own in _sources(options, root, name, compare, configuration)
    ]
    if configuration.source.speed:
        speeds_of(configuration, len(set(sequences)))
        simulated = set(sequences) - {job.sequence for job in jobs if job.odometry == "images"}
        if simulated:
            names = ", ".join(sorted(simulated))
            raise ConfigurationError(f"--speed: the odometry of {names} fuses none; --odometry images does")
    return jobs


def _sources(
    options: argparse.Namespace, root: Path, name: str, compare: bool, configuration: Configuration
) -> list[tuple[str, str, bool]]:
    """Odometry and detections of a sequence's jobs, and whether the ablations go with it.

    Where nothing is asked for, a sequence with images is driven by these too, with the networks' own boxes. Raises
    ConfigurationError where the images or the networks that are asked for are not there.
    """
    camera = camera_with_images(root, name)
    boxes = (root / "det_02_rrc").is_dir()
    detections = options.detections or ("rrc" if boxes else "network")
    seen = camera is not None and (detections == "network" or camera == CAMERA_OF_BOXES)
    odometry = options.odometry or ("images" if seen and (options.detections or not boxes) else "simulate")
    out = [(odometry, detections, True)]
    if compare and camera is not None and boxes and not options.odometry and not options.detections:
        out.append(("images", "network", False))
    for odometry, detections, _ in out:
        own = detections == "network"
        if own and camera is None:
            raise ConfigurationError(f"--detections network: {root} has no image_02 or image_03 of sequence {name}")
        if odometry == "images" and not own and camera != CAMERA_OF_BOXES:
            which = "no image_02" if camera is None else f"no image_02, whose boxes these are, but image_{camera:02d},"
            raise ConfigurationError(f"--odometry images: {root} has {which} of sequence {name}")
        if own and not {"detector", "multitask"} & set(configuration.models.in_use()):
            raise ConfigurationError("--detections network: needs a network that detects: --model detector=PATH")
    return out


def _run_all(jobs: Sequence[Job], processes: int) -> list[Outcome]:
    """Every job in a process of its own, and a line for each that is done."""
    begun_s = time.monotonic()
    if processes == 1 or len(jobs) == 1:
        with Progress("front end", sum(map(frames_to_make, jobs))) as progress:
            outcomes = []
            for k, job in enumerate(jobs, start=1):
                outcome = run_sequence(job, progress.advance)
                progress.clear()
                outcomes.append(_shown(outcome, k, jobs, begun_s))
            return outcomes
    with workers(min(processes, len(jobs))) as pool:
        # The longest first: a long one that begins last is waited for alone
        running = [pool.submit(run_sequence, job) for job in sorted(jobs, key=frames_to_make, reverse=True)]
        return [_shown(done.result(), k, jobs, begun_s) for k, done in enumerate(as_completed(running), start=1)]


def _shown(outcome: Outcome, number: int, jobs: Sequence[Job], begun_s: float) -> Outcome:
    left = len(jobs) - number
    to_go = f", {time_to_go((time.monotonic() - begun_s) * left / number)} to go" if left else ""
    print(
        f"sequence {outcome.sequence}: {len(outcome.frames)} frames, odometry: {outcome.odometry}, done "
        f"({number} of {len(jobs)}{to_go})",
        file=sys.stderr,
        flush=True,
    )
    return outcome


def _write_json(path: Path, rows: Sequence[msgspec.Struct]) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(rows), indent=2) + b"\n")
