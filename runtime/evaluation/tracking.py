"""The tables of the paper on KITTI tracking: the jobs, one process per sequence, and the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path

import msgspec

from birdslam.bench.tracking import tables
from birdslam.bench.tracking.benchmark import methods as every_method
from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES
from birdslam.bench.tracking.picture import draw_runtime
from birdslam.bench.tracking.report import Outcome, Setting, render_report
from birdslam.outputs.drive_files import write_json
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.localisation import sequences_of
from birdslam.runtime.evaluation.tracking_job import Job, frames_to_make, run_sequence
from birdslam.runtime.options import speeds_of
from birdslam.runtime.process.workers import workers
from birdslam.runtime.progress import Progress, time_to_go
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import camera_with_images

PUBLISHED = Path(tables.__file__).with_name("published.toml")
METHODS = tuple(every_method(SlamConfig()))

OnDone = Callable[[Outcome, int, int, str], object]  # outcome of a job, jobs done, all jobs, remaining time


def jobs_of(
    root: Path,
    sequences: str | None,
    configuration: Configuration,
    output: Path,
    *,
    methods: Sequence[str] | None,
    frames: str = "all",
    odometry: str = "",
    detections: str = "",
    seeds: int = 1,
) -> list[Job]:
    """Returns the jobs of the sequences "0002,0003" (None: all). `methods` None: ablations only.

    `frames`: "all", "paper" or "A:B". `odometry` and `detections`: "" selects by the files of a sequence. Raises
    ConfigurationError, DatasetError.
    """
    published = tables.read_published(PUBLISHED)
    names = sequences_of(root, sequences, [*published.sequences] if frames == "paper" else None)
    unknown = [name for name in methods or () if name not in METHODS]
    if unknown:
        raise ConfigurationError(f"--methods: unknown {', '.join(unknown)}; expected {', '.join(METHODS)}")
    jobs = [
        Job(
            root=root,
            sequence=name,
            frames=frames,
            methods=tuple(methods or ()),
            odometry=source,
            detections=boxes,
            seeds=seeds if source == "simulate" else 1,
            ablate=ablate or methods is None,
            output=output,
            configuration=configuration,
            published=published,
        )
        for name in names
        for source, boxes, ablate in _sources(root, name, odometry, detections, methods is not None, configuration)
    ]
    if configuration.source.speed:
        speeds_of(configuration, len(names))
        simulated = set(names) - {job.sequence for job in jobs if job.odometry == "images"}
        if simulated:
            without = ", ".join(sorted(simulated))
            raise ConfigurationError(f"--speed: the odometry of {without} does not use a speed; add --odometry images")
    return jobs


def _sources(
    root: Path, name: str, asked_odometry: str, asked_detections: str, tables: bool, configuration: Configuration
) -> list[tuple[str, str, bool]]:
    """Returns odometry, detections and whether to run the ablations, for each job of a sequence.

    By default, a sequence with images has a second job with visual odometry and the boxes of the networks. Raises
    ConfigurationError if required images or networks are missing.
    """
    camera = camera_with_images(root, name)
    boxes = (root / "det_02_rrc").is_dir()
    detections = asked_detections or ("rrc" if boxes else "network")
    seen = camera is not None and (detections == "network" or camera == CAMERA_OF_BOXES)
    odometry = asked_odometry or ("images" if seen and (asked_detections or not boxes) else "simulate")
    out = [(odometry, detections, True)]
    if tables and camera is not None and boxes and not asked_odometry and not asked_detections:
        out.append(("images", "network", False))
    for odometry, detections, _ in out:
        by_network = detections == "network"
        if by_network and camera is None:
            raise ConfigurationError(f"--detections network: {root} has no image_02 or image_03 of sequence {name}")
        if odometry == "images" and not by_network and camera != CAMERA_OF_BOXES:
            which = "no image_02" if camera is None else f"no image_02, whose boxes these are, but image_{camera:02d},"
            raise ConfigurationError(f"--odometry images: {root} has {which} of sequence {name}")
        if by_network and not {"detector", "multitask"} & set(configuration.models.in_use()):
            raise ConfigurationError("--detections network: needs a detector; add --model detector=PATH")
    return out


def run_jobs(jobs: Sequence[Job], processes: int, on_done: OnDone) -> list[Outcome]:
    """Runs each job in its own process, several in parallel; returns the outcomes ordered by sequence."""
    begun_s, outcomes = time.monotonic(), []

    def take(outcome: Outcome) -> None:
        outcomes.append(outcome)
        left = len(jobs) - len(outcomes)
        to_go = time_to_go((time.monotonic() - begun_s) * left / len(outcomes)) if left else ""
        on_done(outcome, len(outcomes), len(jobs), to_go)

    if processes == 1 or len(jobs) == 1:
        with Progress("front end", sum(map(frames_to_make, jobs))) as progress:
            for job in jobs:
                outcome = run_sequence(job, progress.advance)
                progress.clear()
                take(outcome)
    else:
        with workers(min(processes, len(jobs))) as pool:
            # Longest first, so that no long job runs alone at the end
            running = [pool.submit(run_sequence, job) for job in sorted(jobs, key=frames_to_make, reverse=True)]
            for done in as_completed(running):
                take(done.result())
    return sorted(outcomes, key=lambda o: (o.sequence, o.odometry == "images"))


def write_report(jobs: Sequence[Job], outcomes: Sequence[Outcome], output: Path) -> str:
    """Writes report.md with its data as JSON and its pictures; returns the report."""
    job = jobs[0]
    rows = [row for outcome in outcomes for row in outcome.rows]
    variants = [row for outcome in outcomes for row in outcome.ablation]
    ideas = [row for outcome in outcomes for row in outcome.ideas]
    reported: list[msgspec.Struct] = [row for outcome in outcomes for row in (*outcome.ranges, *outcome.motion)]
    write_json(output / "report.json", rows if job.methods else variants)
    if ideas:
        write_json(output / "ideas.json", ideas)
    if job.methods and variants:
        write_json(output / "ablation.json", variants)
    if reported:
        write_json(output / "reported.json", reported)
    longest = max(outcomes, key=lambda outcome: len(outcome.frames))
    draw_runtime(longest.updates_ms, output / "runtime.png")
    report = render_report(Setting(job.frames, job.methods, max(job.seeds for job in jobs)), job.published, outcomes)
    (output / "report.md").write_text(report, encoding="utf-8")
    return report
