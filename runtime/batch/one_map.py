"""Joins the maps of many drives that share streets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from birdslam.loops.merging import MergeError, merged
from birdslam.loops.place_map import PlaceMap
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.maps.drive_map import DriveMap, Frames
from birdslam.runtime.maps.map_drive import MapChoice
from birdslam.runtime.maps.map_store import read_map, write_map
from birdslam.sources.recording import Recording

DRIVE_MAP = "drive.map"  # among a drive's results


@dataclass(frozen=True)
class Joined:
    """The outcome of joining the drives' maps."""

    keyframes: int
    size: int
    inside: tuple[str, ...]  # drives in the map
    outside: tuple[str, ...]  # drives that share no street with it


def listener(configuration: Configuration, folder: Path) -> DriveMap | None:
    """Returns a listener that builds the drive's map; None if no map is configured."""
    if not configuration.results.map:
        return None
    return DriveMap(MapChoice(folder / DRIVE_MAP, extend=True), None)


def frames(recording: Recording, count: int) -> Frames:
    """Yields the first `count` frames of the recording."""
    for frame in recording.undistorted_frames():
        if frame.frame_id >= count:
            return
        yield frame.frame_id, frame.t_source_ns, frame.image


def join(folders: Sequence[Path], path: Path) -> Joined | None:
    """Joins the maps of these drives into the map at `path`, or into a new one; returns None if no drive has a map.

    A new map starts with the longest; passes merge maps that share a street until none is left. Each merge optimizes
    the whole map. Raises MapError.
    """
    maps = {folder.name: read_map(folder / DRIVE_MAP) for folder in folders if (folder / DRIVE_MAP).is_file()}
    waiting = sorted(maps, key=lambda name: (-len(maps[name]), name))
    if not waiting:
        return None
    inside: list[str] = []
    if path.is_file():
        whole: PlaceMap = read_map(path)
    else:
        inside.append(waiting.pop(0))
        whole = maps[inside[0]]
    found = True
    while found:
        found = False
        for name in list(waiting):
            try:
                whole, _ = merged(whole, maps[name])
            except MergeError:
                continue
            found = True
            waiting.remove(name)
            inside.append(name)
    return Joined(len(whole), write_map(path, whole), tuple(inside), tuple(waiting))
