"""Localisation and mapping of a drive frame by frame: writes `map.tum.txt`, `localisation.csv` and the map.

Used after a drive (drive_map.py) and during it (map_process.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_pose import EarthPose, MapPose, MapState
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.outputs.map_trajectory import MapTrajectory, TrajectoryFiles
from birdslam.outputs.placed import Place
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.maps.held_way import HeldTrajectory
from birdslam.runtime.maps.map_store import check_map, write_map
from birdslam.types import NS_PER_S, Estimate


@dataclass(frozen=True)
class MapChoice:
    """The map file, and whether the drive extends it."""

    path: Path
    extend: bool

    @staticmethod
    def of(configuration: Configuration) -> MapChoice | None:
        """Returns the configured map; None without one. Raises ConfigurationError."""
        results = configuration.results
        if results.map and results.map_only:
            raise ConfigurationError("results.map, results.map_only: name only one of them")
        if results.map or results.map_only:
            return MapChoice(Path(results.map or results.map_only).expanduser(), bool(results.map))
        return None

    def open(self, camera: Camera) -> PlaceMap:
        """Returns the initial map of the drive. Raises MapError, or ConfigurationError for one of another camera."""
        found = check_map(self.path, self.extend)
        if found is None:
            return PlaceMap(MapCamera.of(camera))
        other = found.camera.differs(camera)
        if other and self.extend:
            raise ConfigurationError(
                f"{self.path}: is the map of another camera: {other}; localise in it by --map-only, or name a new map"
            )
        return found


class MapDrive:
    """`step` processes a frame, `end` ends the drive, `save` writes the current map."""

    def __init__(self, choice: MapChoice, camera: Camera, output: Path) -> None:
        """Raises MapError, ConfigurationError, OSError."""
        self.map = choice.open(camera)
        self._held = HeldTrajectory()
        self._choice = choice
        self._before = self._saved = len(self.map)
        self._session = MapSession(camera, self.map, choice.extend)
        self._trajectory, self._files = MapTrajectory(), TrajectoryFiles(output)
        self._begin_ns: int | None = None
        self._frame_id = -1
        self.unwritten: OSError | None = None  # the disk error that ended the drive's files

    def resume(self, pose: MapPose) -> None:
        """Continues from the last pose of the previous process."""
        self._session.resume(pose)

    def due(self, estimate: Estimate) -> bool:
        """Whether the image of the next frame is processed."""
        return self._session.due(estimate)

    def step(self, estimate: Estimate, image: NDArray[np.uint8] | None) -> Localisation:
        """Processes a frame; `image` is undistorted, None: not processed. A frame published again adds no row."""
        if self._begin_ns is None:
            self._begin_ns = estimate.t_source_ns
        found = self._session.step(estimate, image)
        if estimate.frame_id != self._frame_id:
            self._write(self._trajectory.add(found, estimate))
        self._frame_id = estimate.frame_id
        if found.T_map_ego is not None and estimate.valid:
            self._held.add(estimate, found.T_map_ego, self.map)
        return found

    @property
    def places(self) -> list[Place]:
        """The drive's trajectory, about one pose per metre, for the current poses of the map's keyframes."""
        return self._held.places(self.map)

    def _write(self, settled: list[Localisation]) -> None:
        if self.unwritten is None:
            try:
                self._files.write(settled)
            except OSError as error:
                self.unwritten = error

    @property
    def T_map_odom(self) -> SE2 | None:
        """The transform between the frames of REP-105; None when lost."""
        return self._session.localiser.T_map_odom

    def on_earth(self, found: Localisation) -> EarthPose | None:
        """Returns the ego's pose on Earth, if the map is georeferenced."""
        return None if found.T_map_ego is None else self.map.on_earth(found.T_map_ego, found.cov)

    @property
    def unsaved(self) -> bool:
        """Whether the map has keyframes that are not saved."""
        return self._choice.extend and len(self.map) > self._saved

    def save(self) -> int:
        """Writes the current map if the drive extends it; returns its size in bytes. Raises MapError."""
        if not self._choice.extend:
            return 0
        size = write_map(self._choice.path, self.map)
        self._saved = len(self.map)
        return size

    def end(self) -> None:
        """Adds the last keyframes, closes loops, and completes the files of the drive. Raises OSError."""
        self._session.finish()
        self._write(self._trajectory.finish())
        if self.unwritten is None:
            self._files.close()
        else:
            raise self.unwritten

    def summary(self) -> dict[str, Any]:
        """Returns the entries of summary.json after `end`."""
        first_ns, begin_ns = self._trajectory.first_ns, self._begin_ns
        return {
            "file": str(self._choice.path),
            **self._trajectory.counts,
            "time_to_localise_s": None
            if first_ns is None or begin_ns is None
            else round((first_ns - begin_ns) / NS_PER_S, 3),
            "keyframes": len(self.map),
            "new_keyframes": len(self.map) - self._before,
            "keyframes_without_place": self._session.lost_keyframes,
        }

    def write(self, summary: dict[str, Any]) -> None:
        """Writes the map at the end of the drive, if the drive extends it. Raises MapError."""
        if not self._choice.extend:
            return
        if len(self.map):
            summary["bytes"] = self.save()
        else:
            summary["file"] = None  # no keyframe for a later drive to match


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the rows of a run's summary table about the map."""
    if "error" in found:
        return [("map", f"NOT SAVED: {found['error']}")]
    frames = sum(found[state.value] for state in MapState)
    out = [("localised in the map", f"{found['localised']} of {frames} frames: map.tum.txt, localisation.csv")]
    if found["time_to_localise_s"] is not None:
        out.append(("  first after", f"{found['time_to_localise_s']:.1f} s"))
    if "bytes" in found:
        size = f"{found['keyframes']} keyframes, {found['new_keyframes']} of them new, {found['bytes'] / 1e6:.2f} MB"
        out.append(("map", f"{found['file']}: {size}"))
    elif found["file"] is None:
        out.append(("map", "none: the drive gave no keyframe"))
    if found["keyframes_without_place"]:
        out.append(("  not in the map", f"{found['keyframes_without_place']} keyframes: the drive never met the map"))
    return out
