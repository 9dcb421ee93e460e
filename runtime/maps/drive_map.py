"""A drive and a map, when the drive is over: one pass over the recording's frames and the estimates of each.

It costs the drive nothing but the memory of its estimates, and the same estimates give the same map.
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
    """Raises MapError, GnssError or ConfigurationError for what the drive could not use."""
    choice, gnss = MapChoice.of(configuration), configuration.results.gnss
    if choice is not None:
        choice.open(camera)
    if gnss and is_serial(gnss):
        if not configuration.maps_live:
            raise ConfigurationError("results.gnss: a receiver is heard by the map process: a live drive with --map")
        Receiver(gnss).close()
    else:
        recorded_fixes(configuration)


class DriveMap:
    """Listens to the drive (`add`), and makes the map of it, or its place on Earth, or both (`finish`)."""

    def __init__(self, choice: MapChoice | None, gnss: Fixes | None) -> None:
        self._choice, self._gnss = choice, gnss
        self._estimates: list[Estimate] = []

    @staticmethod
    def of(configuration: Configuration) -> DriveMap | None:
        """What the configuration asks for and no process does meanwhile; None: nothing.

        Raises ConfigurationError, GnssError.
        """
        if configuration.maps_live:
            return None
        choice, gnss = MapChoice.of(configuration), recorded_fixes(configuration)
        return None if choice is None and gnss is None else DriveMap(choice, gnss)

    def add(self, estimate: Estimate) -> None:
        """Keeps what the map needs of it."""
        if Status.END_OF_SOURCE not in estimate.status:
            self._estimates.append(msgspec.structs.replace(estimate, vehicles=()))

    def add_map(self, update: MapUpdate) -> None:
        """Lanes and landmarks are not in the map of places."""

    def finish(self, camera: Camera, frames: Frames, output: Path) -> dict[str, Any]:
        """Writes what was asked for; what summary.json says: "map", "earth".

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
        """The pass over the frames."""
        waiting = iter(frames)
        frame_id, image = -1, None
        with Progress("map", len(self._estimates)) as progress:
            for estimate in self._estimates:
                while frame_id < estimate.frame_id:
                    frame_id, _, image = next(waiting, (estimate.frame_id, 0, None))
                drive.step(estimate, image if frame_id == estimate.frame_id else None)
                progress.advance()
        drive.end()
