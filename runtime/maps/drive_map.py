"""A drive and a map, when the drive is over: one pass over the recording's frames and the estimates of each.

It costs the drive nothing but the memory of its estimates, and the same estimates give the same map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.loops.gnss_file import GNSS_FILE, read_fixes
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.outputs.map_trajectory import MapTrajectory
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.maps.drive_earth import Poses, poses_of, read_gnss, write_earth
from birdslam.runtime.maps.map_store import check_map, write_map
from birdslam.runtime.progress import Progress
from birdslam.types import Estimate, MapUpdate, Status

Frames = Iterator[tuple[int, int, NDArray[np.uint8] | None]]


@dataclass(frozen=True)
class MapChoice:
    """Which map, and whether the drive may write it."""

    path: Path
    extend: bool

    @staticmethod
    def of(configuration: Configuration) -> MapChoice | None:
        """What the configuration asks for; None: no map. Raises ConfigurationError."""
        results = configuration.results
        if results.map and results.map_only:
            raise ConfigurationError("results.map, results.map_only: a map is written, or only read; name one of them")
        if results.map or results.map_only:
            return MapChoice(Path(results.map or results.map_only).expanduser(), bool(results.map))
        return None

    def open(self, camera: Camera) -> PlaceMap:
        """The map that the drive begins with. Raises MapError, or ConfigurationError for one of another camera."""
        found = check_map(self.path, self.extend)
        if found is None:
            return PlaceMap(MapCamera.of(camera))
        other = found.camera.differs(camera)
        if other and self.extend:
            raise ConfigurationError(
                f"{self.path}: is the map of another camera: {other}; localise in it by --map-only, "
                "or begin another map"
            )
        return found


class DriveMap:
    """Listens to the drive (`add`), and makes the map of it, or its place on Earth, or both (`finish`)."""

    def __init__(self, choice: MapChoice | None, gnss: Path | None, live: bool = False) -> None:
        self._choice, self._gnss, self._live = choice, gnss, live
        self._estimates: list[Estimate] = []

    @staticmethod
    def of(configuration: Configuration) -> DriveMap | None:
        """What the configuration asks for; None: neither. Raises ConfigurationError."""
        choice, results = MapChoice.of(configuration), configuration.results
        gnss = Path(results.gnss).expanduser() if results.gnss else None
        if gnss is None and configuration.source.topics.gnss and configuration.live:
            gnss = Path(configuration.output) / GNSS_FILE  # it grows while the car drives
        return None if choice is None and gnss is None else DriveMap(choice, gnss, configuration.live)

    def check(self, camera: Camera) -> None:
        """Raises MapError, GnssError or ConfigurationError for what the drive could not use in the end."""
        if self._choice is not None:
            self._choice.open(camera)
        if self._gnss is not None and not self._live:
            read_fixes(read_gnss(self._gnss), str(self._gnss), 0)

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
        summary: dict[str, Any] = {}
        place_map, poses = None, poses_of(self._estimates)
        if self._choice is not None:
            place_map = self._choice.open(camera)
            summary["map"], poses = self._localise(self._choice, place_map, camera, frames, output)
        if self._gnss is not None and (self._gnss.is_file() or not self._live):  # live there may have been no fix
            summary["earth"] = write_earth(self._gnss, poses, camera, output, place_map)
        if self._choice is not None and self._choice.extend and place_map is not None:
            if len(place_map):
                summary["map"]["bytes"] = write_map(self._choice.path, place_map)
            else:
                summary["map"]["file"] = None  # nothing that a later drive could be found by
        return summary

    def _localise(
        self, choice: MapChoice, place_map: PlaceMap, camera: Camera, frames: Frames, output: Path
    ) -> tuple[dict[str, Any], Poses]:
        """The pass over the frames; what is said of it, and the poses in the map."""
        before = len(place_map)
        session, trajectory = MapSession(camera, place_map, choice.extend), MapTrajectory()
        poses: Poses = []
        waiting = iter(frames)
        frame_id, image = -1, None
        with Progress("map", len(self._estimates)) as progress:
            for estimate in self._estimates:
                while frame_id < estimate.frame_id:
                    frame_id, _, image = next(waiting, (estimate.frame_id, 0, None))
                found = session.step(estimate, image if frame_id == estimate.frame_id else None)
                trajectory.add(found, estimate)
                if found.T_map_ego is not None:
                    poses.append((found.t_source_ns, found.T_map_ego))
                progress.advance()
        session.finish()
        trajectory.write(output)
        counts = trajectory.counts
        first = next((k for k, row in enumerate(trajectory.as_found) if row == "localised"), None)
        summary = {
            "file": str(choice.path),
            **counts,
            "time_to_localise_s": None
            if first is None
            else round((self._estimates[first].t_source_ns - self._estimates[0].t_source_ns) / 1e9, 3),
            "keyframes": len(place_map),
            "new_keyframes": len(place_map) - before,
            "keyframes_without_place": session.lost_keyframes,
        }
        return summary, poses


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of a run's table that speak of the map."""
    frames = sum(found[state] for state in ("localised", "odometry_only", "lost"))
    out = [("localised in the map", f"{found['localised']} of {frames} frames: map.tum.txt, localisation.csv")]
    if found["time_to_localise_s"] is not None:
        out.append(("  first after", f"{found['time_to_localise_s']:.1f} s"))
    if "bytes" in found:
        size = f"{found['keyframes']} keyframes, {found['new_keyframes']} of them new, {found['bytes'] / 1e6:.2f} MB"
        out.append(("map", f"{found['file']}: {size}"))
    elif found["file"] is None:
        out.append(("map", "none: no keyframe could be made of this drive"))
    if found["keyframes_without_place"]:
        out.append(("  without a place", f"{found['keyframes_without_place']} keyframes: the drive never met the map"))
    return out
