"""The errors of a run over the shipped drive, which has ground truth.

Estimates and map updates are kept in memory during the drive and compared after the run.
"""

from __future__ import annotations

from typing import Any

import msgspec

from birdslam.bench.tracking.shipped_drive import VEHICLES, DemoGrade, grade
from birdslam.geometry.arrays import Floats
from birdslam.outputs.drive_video import outline
from birdslam.runtime.configuration import Configuration
from birdslam.sources.opening import open_recording
from birdslam.sources.schemes import DEMO, scheme_of
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.types import Estimate, MapUpdate


class DemoReport:
    """Collects the published estimates and map updates."""

    def __init__(self, recording: DemoRecording) -> None:
        self._recording = recording
        self.records: list[Estimate | MapUpdate] = []

    @classmethod
    def of(cls, configuration: Configuration) -> DemoReport | None:
        """Returns None if the drive has no ground truth of vehicles, or no end."""
        source = configuration.source
        if scheme_of(source.uri, [DEMO]) is None or source.loop:
            return None
        recording = open_recording(source.uri, configuration.camera, source.stride)
        assert isinstance(recording, DemoRecording)
        return cls(recording)

    def add(self, estimate: Estimate) -> None:
        """Adds the estimate of a frame."""
        self.records.append(estimate)

    def add_map(self, update: MapUpdate) -> None:
        """Adds the map update of a frame."""
        self.records.append(update)

    def grade(self) -> DemoGrade | None:
        """Returns the errors of the run; None without an estimate."""
        estimates = [record for record in self.records if isinstance(record, Estimate)]
        return grade(self._recording, estimates) if estimates else None

    def true_outlines(self, frame_id: int) -> list[Floats]:
        """Returns the footprints (4, 2) in ego of the vehicles that are visible in a frame."""
        return [
            outline(body.T_ego_body, body.length_m, body.width_m)
            for body in self._recording.truth_bodies(frame_id)
            if body.label in VEHICLES and body.visible > 0.0
        ]


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the rows of the summary table about the ground truth; none if there is none."""
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
            f"median; {number(found.reported, '.0%')} of the clearly visible ones reported, "
            f"{number(found.found, '.0%')} detected in that frame",
        ),
        (
            "movers",
            f"{found.false_movers} of {found.standing} tracks of stationary vehicles reported as moving; of "
            f"{found.driving} of moving ones {found.driving - found.missed_movers}, "
            f"{found.movers_soon} of them within 1 s",
        ),
    ]
