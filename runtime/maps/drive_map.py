"""Localisation and mapping after a drive: one pass over the recording's frames and estimates.

During the drive only the estimates are stored; the same estimates give the same map.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.outputs.placed import write_places
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.maps.drive_earth import places_of, write_earth
from birdslam.runtime.maps.gnss_input import Fixes, Receiver, is_serial, recorded_fixes
from birdslam.runtime.maps.map_drive import MapChoice, MapDrive
from birdslam.runtime.progress import Progress
from birdslam.types import Estimate, MapUpdate, Status

Frames = Iterator[tuple[int, int, NDArray[np.uint8] | None]]


def check_map_choice(configuration: Configuration, camera: Camera) -> None:
    """Raises MapError, GnssError or ConfigurationError for an unusable map or GNSS input."""
    choice, gnss = MapChoice.of(configuration), configuration.results.gnss
    if choice is not None:
        choice.open(camera)
    if gnss and is_serial(gnss):
        if not configuration.maps_live:
            raise ConfigurationError("results.gnss: a receiver needs a live drive with --map")
        Receiver(gnss).close()
    else:
        recorded_fixes(configuration)


class DriveMap:
    """Collects estimates (`add`) and then builds the map, georeferences the drive, or both (`finish`)."""

    def __init__(self, choice: MapChoice | None, gnss: Fixes | None) -> None:
        self._choice, self._gnss = choice, gnss
        self._estimates: list[Estimate] = []

    @staticmethod
    def of(configuration: Configuration) -> DriveMap | None:
        """Returns what the configuration requests after the drive; None if nothing, or if the map process does it.

        Raises ConfigurationError, GnssError.
        """
        if configuration.maps_live:
            return None
        choice, gnss = MapChoice.of(configuration), recorded_fixes(configuration)
        return None if choice is None and gnss is None else DriveMap(choice, gnss)

    def add(self, estimate: Estimate) -> None:
        """Stores an estimate without its vehicles."""
        if Status.END_OF_SOURCE not in estimate.status:
            self._estimates.append(msgspec.structs.replace(estimate, vehicles=()))

    def add_map(self, update: MapUpdate) -> None:
        """Does nothing: the map has no landmarks of the graph."""

    def finish(self, camera: Camera, frames: Frames, output: Path) -> dict[str, Any]:
        """Writes the requested results; returns "map" and "earth" of summary.json.

        Raises MapError, GnssError, EarthError, OSError or ConfigurationError.
        """
        if self._choice is None:
            if self._gnss is None:
                return {}
            earth, places = write_earth(self._gnss, places_of(self._estimates), camera, output, None)
            write_places(output, places)
            return {"earth": earth}
        drive = MapDrive(self._choice, camera, output)
        self._localise(drive, frames)
        summary: dict[str, Any] = {"map": drive.summary()}
        if self._gnss is not None:
            summary["earth"], places = write_earth(self._gnss, drive.places, camera, output, drive.map)
            write_places(output, places)
        else:
            write_places(output, drive.places)
        drive.write(summary["map"])
        return summary

    def _localise(self, drive: MapDrive, frames: Frames) -> None:
        """Processes all frames."""
        waiting = iter(frames)
        frame_id, image = -1, None
        with Progress("map", len(self._estimates)) as progress:
            for estimate in self._estimates:
                while frame_id < estimate.frame_id:
                    frame_id, _, image = next(waiting, (estimate.frame_id, 0, None))
                drive.step(estimate, image if frame_id == estimate.frame_id else None)
                progress.advance()
        drive.end()
