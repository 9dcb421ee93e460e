"""Repeated drives: recall and false loops of place recognition, errors of localization, gain of loop closure.

    python -m perf loops [--output FILE.json] [--part recorded|loop|gnss|size ...]

`recorded`: two passes of a KITTI street, each in the map of the other, and other streets in both. `loop`: simulated
features. `gnss`: fixes that jump. `size`: simulated descriptors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_file import decode_map, encode_map
from birdslam.loops.map_pose import MapState
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.outputs.map_trajectory import MapTrajectory
from birdslam.perf.maps import simulated
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.configuration import load
from birdslam.runtime.nodes.sources import open_recorded
from birdslam.types import Estimate

label = "place recognition, localization in a kept map, loop closure; a map's size and look-up time"

PARTS = "recorded", "loop", "gnss", "size"
Seen = tuple[Estimate, NDArray[np.uint8]]
BASELINE_M = 0.537  # between the cameras of the two passes
OTHERS = ("kitti_odometry/sequences/00", "kitti_odometry/sequences/06", "kitti_tracking/training/image_03/0005")


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("loops", label)
    add_data(parser)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--way", type=float, default=2000.0, metavar="M", help="length of the simulated loop")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    with Ledger(options.output, label, way_m=options.way) as ledger:
        if "recorded" in options.part:
            recorded(ledger, options.data)
        if "loop" in options.part:
            simulated.loop(ledger, options.way)
        if "gnss" in options.part:
            simulated.gnss(ledger, options.way)
        if "size" in options.part:
            simulated.size(ledger)


def estimated(uri: str) -> Iterator[Seen]:
    """The estimates of the whole pipeline for a recording, with the undistorted images."""
    recording, frames = open_recorded(uri), open_recorded(uri).undistorted_frames()
    with pipeline(load(None, {"source.uri": uri})) as through:
        for estimate in (record for record in through(recording) if isinstance(record, Estimate)):
            frame = next(each for each in frames if each.frame_id == estimate.frame_id)
            if frame.image is not None:
                yield estimate, frame.image


def recorded(ledger: Ledger, data: Path) -> None:
    """The two passes, and other streets in their maps."""

    def read(name: str) -> tuple[Camera, list[Seen]]:
        uri = f"kitti:{data / name}"
        return open_recorded(uri).camera, list(estimated(uri))

    passes = {name: read(f"two_passes/{name}") for name in ("left", "right")}
    others = {Path(name).name: read(name) for name in OTHERS if (data / name).exists()}
    for name, other, side in (("left", "right", -1.0), ("right", "left", 1.0)):
        camera, frames = passes[name]
        kept = encode_map(build_map(camera, frames))
        found = localise(*passes[other], kept)
        truth = [estimate.T_world_ego @ SE2(0.0, side * BASELINE_M, 0.0) for estimate, _ in frames]
        row = evaluate(found, truth) | {"MB_a_km": round(len(kept) / 1e3 / max(decode_map(kept).length_m, 1.0), 2)}
        ledger.add(f"{other} in the map of {name}", row_text(row), **row)
        for street, (street_camera, drive) in others.items():
            states = localise(street_camera, drive, kept).poses
            text = f"{len(states)} of {len(drive)} frames localised, all of them falsely"
            ledger.add(f"{street} in the map of {name}", text, false=len(states), frames=len(drive))


def build_map(camera: Camera, frames: Iterable[Seen]) -> PlaceMap:
    """The map of a drive."""
    place_map = PlaceMap(MapCamera.of(camera))
    session = MapSession(camera, place_map, True)
    for estimate, image in frames:
        session.step(estimate, image)
    session.finish()
    return place_map


@dataclass(frozen=True)
class Localised:
    """A drive in a kept map, as `birdslam run --map-only` writes it."""

    rows: list[Localisation]
    frames_before: int  # first frame that was localised online

    @property
    def poses(self) -> list[Localisation]:
        return [row for row in self.rows if row.state is MapState.LOCALISED]


def localise(camera: Camera, frames: Iterable[Seen], kept: bytes) -> Localised:
    session, trajectory = MapSession(camera, decode_map(kept), False), MapTrajectory()
    rows: list[Localisation] = []
    for estimate, image in frames:
        rows += trajectory.add(session.step(estimate, image), estimate)
    rows += trajectory.finish()
    return Localised(rows, trajectory.frames_before)


def evaluate(trajectory: Localised, truth: Sequence[SE2]) -> dict[str, Any]:
    """Errors of the localised frames relative to the map's own drive."""
    found = trajectory.poses
    row: dict[str, Any] = {"frames": len(trajectory.rows), "localised": len(found)}
    row["frames_to_localise"] = trajectory.frames_before
    if found:
        error = np.array([truth[each.frame_id].between(each.T_map_ego).log() for each in found if each.T_map_ego])
        sigma = np.array([np.sqrt(np.diag(each.cov)) for each in found])
        position = np.hypot(error[:, 0], error[:, 1])
        row |= {
            "median_m": round(float(np.median(position)), 4),
            "worst_m": round(float(position.max()), 4),
            "median_deg": round(float(np.degrees(np.median(np.abs(error[:, 2])))), 4),
            "within_2_sigma": [round(float(share), 3) for share in (np.abs(error) < 2.0 * sigma).mean(axis=0)],
        }
    return row


def row_text(row: dict[str, Any]) -> str:
    if not row["localised"]:
        return f"0 of {row['frames']} localised"
    x, y, yaw = row["within_2_sigma"]
    size = f", {row['MB_a_km']} MB a km" if "MB_a_km" in row else ""
    return (
        f"{row['localised']} of {row['frames']} localised (first as frame {row['frames_to_localise']}), "
        f"median {row['median_m']:.3f} m {row['median_deg']:.3f} deg, worst {row['worst_m']:.3f} m, "
        f"within 2 sigma {x:.2f} {y:.2f} {yaw:.2f}{size}"
    )
