"""The tables of the paper on KITTI tracking: the jobs, one process per sequence, and the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from pathlib import Path

from birdslam.bench.tracking import tables
from birdslam.bench.tracking.localisation import BOXES
from birdslam.bench.tracking.report import Outcome, render_report
from birdslam.outputs.drive_files import write_json
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.localisation import sequences_of
from birdslam.runtime.evaluation.tracking_job import Job, frames_to_make, run_sequence
from birdslam.runtime.process.workers import workers
from birdslam.runtime.progress import Progress, time_to_go
from birdslam.sources.kitti_tracking import camera_with_images

PUBLISHED = Path(tables.__file__).with_name("published.toml")

OnDone = Callable[[Outcome, int, int, str], object]  # outcome of a job, jobs done, all jobs, remaining time


def jobs_of(
    root: Path, sequences: str | None, configuration: Configuration, output: Path, *, frames: str, seeds: int
) -> list[Job]:
    """Returns the jobs of the sequences "0002,0003" (None: all).

    A sequence has a job with simulated odometry and recorded boxes if there are boxes, and one with visual odometry
    and the networks if there are images. `frames`: "all", "paper" or "A:B". Raises ConfigurationError, DatasetError.
    """
    published = tables.read_published(PUBLISHED)
    names = sequences_of(root, sequences, [*published.sequences] if frames == "paper" else None)
    jobs = []
    for name in names:
        has_boxes, has_images = (root / BOXES).is_dir(), camera_with_images(root, name) is not None
        if not has_boxes and not has_images:
            raise ConfigurationError(f"{root}: has neither {BOXES} nor images of sequence {name}")
        if has_images and not {"detector", "multitask"} & set(configuration.models.in_use()):
            raise ConfigurationError(f"sequence {name} has images, which need a detector; add --model detector=PATH")
        for images in (False,) * has_boxes + (True,) * has_images:
            count = 1 if images else seeds
            jobs.append(Job(root, name, frames, images, count, output, configuration, published))
    return jobs


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
    """Writes report.md with its data as JSON; returns the report."""
    write_json(output / "report.json", [row for outcome in outcomes for row in outcome.rows])
    write_json(output / "ablation.json", [row for outcome in outcomes for row in outcome.ablation])
    write_json(output / "ideas.json", [row for outcome in outcomes for row in outcome.ideas])
    report = render_report(jobs[0].frames, max(job.seeds for job in jobs), jobs[0].published, outcomes)
    (output / "report.md").write_text(report, encoding="utf-8")
    return report
