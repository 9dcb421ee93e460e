"""What is said of a run over the shipped drive, whose truth is known: how good it was, and a video of it.

All that was estimated is kept while the drive goes on, half a minute of it; comparing and drawing come after the run.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec

from birdslam.datasets.demo import NAME, DemoRecording
from birdslam.datasets.opening import open_recording
from birdslam.evaluation.demo import VEHICLES, DemoGrade, grade
from birdslam.evaluation.video import Image, SideBySide, outline
from birdslam.runtime.configuration import Configuration
from birdslam.types import Estimate, MapUpdate

VIDEO = "drive.mp4"
CODEC = "mp4v"  # the one that every build of OpenCV can write
EVERY = 2  # frames of the drive for one of the video: half the work


class Witness:
    """Takes what the planner is told, as birdslam.results.Recorder does."""

    def __init__(self, recording: DemoRecording) -> None:
        self._recording = recording
        self._estimates: list[Estimate] = []
        self._map: dict[int, MapUpdate] = {}

    @classmethod
    def of(cls, configuration: Configuration) -> Witness | None:
        """None where the drive has no truth of vehicles, or no end."""
        source = configuration.source
        if source.uri.partition(":")[0] != NAME or source.loop:
            return None
        recording = open_recording(source.uri, configuration.camera, source.stride)
        assert isinstance(recording, DemoRecording)
        return cls(recording)

    def add(self, estimate: Estimate) -> None:
        """One frame's."""
        self._estimates.append(estimate)

    def add_map(self, update: MapUpdate) -> None:
        """What the map gained with a frame."""
        self._map[update.frame_id] = update

    def finish(self, output: Path) -> dict[str, Any]:
        """Compares and writes the video. What summary.json says of it; nothing where nothing was estimated."""
        if not self._estimates:
            return {}
        grade_of_run = grade(self._recording, self._estimates)
        return {"truth": msgspec.to_builtins(grade_of_run), "video": self._write_video(output / VIDEO)}

    def _write_video(self, path: Path) -> str | None:
        """Its path; None where this OpenCV can't write one."""
        view = SideBySide(self._recording.camera)
        writer = cv2.VideoWriter(
            str(path), cv2.VideoWriter.fourcc(*CODEC), self._recording.rate_hz / EVERY, view.size_px
        )
        try:
            if not writer.isOpened():
                return None
            for picture in self._pictures(view):
                writer.write(picture)
        finally:
            writer.release()
        return str(path)

    def _pictures(self, view: SideBySide) -> Iterator[Image]:
        left = {estimate.frame_id: estimate for estimate in self._estimates}
        latest: Estimate | None = None
        for frame in self._recording.frames():
            update = self._map.get(frame.index)
            if update is not None:
                view.add_map(update)
            latest = left.get(frame.index, latest)
            if frame.index % EVERY or frame.image is None or latest is None:
                continue
            if frame.index > self._estimates[-1].frame_id:
                return
            truth = [
                outline(body.T_ego_body, body.length_m, body.width_m)
                for body in self._recording.truth_bodies(latest.frame_id)
                if body.label in VEHICLES and body.visible > 0.0
            ]
            seconds = frame.t_source_ns * 1e-9
            seen = sum(vehicle.age_ns == 0 for vehicle in latest.vehicles)
            status = " ".join(status.value for status in latest.status) or "all well"
            words = (
                f"BirdSLAM  {seconds:5.1f} s  frame {latest.frame_id}  {seen} vehicles in sight",
                "right: from above, 10 m rings; filled: estimates, white outlines: truth, cyan: ego",
                status,
            )
            yield view.draw(frame.image, latest, truth, words)


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of the table of a run that speak of the truth; none where none is known."""
    if "truth" not in summary:
        return []
    found = msgspec.convert(summary["truth"], DemoGrade)

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    share = None if found.ego_ate_pct is None else found.ego_ate_pct / 100.0
    return [
        (
            "ATE of the ego",
            f"{found.ego_ate_m:.2f} m, {number(share, '.2%')} of {found.path_m:.1f} m "
            f"(scale {number(found.ego_scale_error, '+.2%')})",
        ),
        (
            "ATE of vehicles",
            f"{number(found.vehicle_ate_m, '.2f')} m in the global frame, median of {found.vehicles} vehicles",
        ),
        (
            "  from the ego",
            f"{number(found.vehicle_centre_m, '.2f')} m, {number(found.vehicle_centre_rel, '.1%')} of the range, "
            f"median; {number(found.found, '.0%')} of those in clear sight found",
        ),
        ("video", summary["video"] or f"none: this OpenCV can't write {CODEC}"),
    ]
