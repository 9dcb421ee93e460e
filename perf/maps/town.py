"""A rendered town loop: two rounds for the map, then drives in other conditions (see world/town.py)."""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_file import decode_map, encode_map
from birdslam.loops.map_pose import MapState
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.perf.errors import PerfError
from birdslam.perf.maps.estimates import Seen, estimated
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.progress import with_progress
from birdslam.runtime.world.demo_drive import write
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import inverse, mount_pose, split_pose

QUALITY = 90  # of the WebP images
TWICE = "twice"
BEGIN = "begin.npy"  # T_world_cam of a drive's first image, the common frame of two drives
FALSE_M = 2.0  # min. error of a false loop or a false pose
KIDNAPPED = ("traffic", "lane", 150)  # from this image of one drive to the first of the other


@dataclass(frozen=True)
class _Drive:
    """A rendered drive: its recording, and the true ego pose of each frame in world."""

    recording: DemoRecording
    truth: list[SE2]

    @staticmethod
    def open(folder: Path) -> _Drive:
        recording = DemoRecording(folder)
        mount = mount_pose(recording.camera.ground)
        T_world_cam0 = np.load(folder / BEGIN)
        poses = np.tile(np.eye(4), (len(recording), 1, 1))
        poses[:, :3] = recording.truth_poses()
        return _Drive(recording, [split_pose(T_world_cam0 @ T @ inverse(mount))[0] for T in poses])


def measure(ledger: Ledger, drives: Path) -> None:
    """Measures all drives of the town; missing ones are rendered. Raises PerfError."""
    names = render(drives)
    place_map, T_world_map = _twice(ledger, drives / TWICE)
    kept = encode_map(place_map)
    before = {name: list(estimated(f"demo:{drives / name}")) for name in KIDNAPPED[:2]}
    for name, differs in names.items():
        if name != TWICE:
            drive = _Drive.open(drives / name)
            frames = before.get(name) or estimated(f"demo:{drives / name}")
            found = _localise(kept, drive, frames)
            row = _evaluate(found, drive.truth, place_map, T_world_map)
            ledger.add(f"town: {differs}", row["text"], **row)
    _measure_jump(ledger, drives, kept, place_map, T_world_map, before)


def render(folder: Path) -> dict[str, str]:
    """Name -> folder of each drive, after rendering missing ones."""
    if importlib.util.find_spec("numba") is None:
        known = folder / "drives.json"
        if not known.is_file():
            raise PerfError("rendering needs numba; install the extra [train], or name rendered drives with --drives")
        return msgspec.json.decode(known.read_bytes(), type=dict[str, str])
    from birdslam.world.roads import CAMERA
    from birdslam.world.town import DRIVES, RATE_HZ, frames

    for name, planned in DRIVES.items():
        if not (folder / name / BEGIN).is_file():
            rendered = with_progress(frames(name), name, planned.frames)
            first = next(rendered)
            write(folder / name, itertools.chain([first], rendered), CAMERA, RATE_HZ, QUALITY)
            np.save(folder / name / BEGIN, first.T_world_cam)
    out = {name: planned.differs for name, planned in DRIVES.items()}
    (folder / "drives.json").write_bytes(msgspec.json.encode(out))
    return out


def _twice(ledger: Ledger, folder: Path) -> tuple[PlaceMap, dict[int, SE2]]:
    """Two rounds: gain of the loop closure; returns the map and the true pose of each keyframe by number."""
    drive = _Drive.open(folder)
    place_map = PlaceMap(MapCamera.of(drive.recording.camera))
    session = MapSession(drive.recording.camera, place_map, True)
    truth = {}
    odometry: dict[int, SE2] = {}
    T_map_world: SE2 | None = None
    last: Localisation | None = None
    localised = frames = 0
    for estimate, image in estimated(f"demo:{folder}"):
        last = session.step(estimate, image)
        if T_map_world is None and estimate.valid:
            T_map_world = estimate.T_world_ego @ drive.truth[estimate.frame_id].inverse()
        truth[estimate.t_source_ns], odometry[estimate.t_source_ns] = (
            drive.truth[estimate.frame_id],
            estimate.T_world_ego,
        )
        second_round = estimate.frame_id > len(drive.truth) // 2
        frames += second_round
        localised += second_round and last.state is MapState.LOCALISED
    session.finish()
    if T_map_world is None or last is None:
        raise PerfError(f"{folder}: the odometry was never valid")
    way_m = float(np.hypot(*np.diff([(T.x_m, T.y_m) for T in drive.truth], axis=0).T).sum())
    end = T_map_world @ drive.truth[-1]
    T_end = session.localiser.T_map_odom @ odometry[last.t_source_ns] if session.localiser.T_map_odom else None
    open_m, closed_m = _distance_m(end, odometry[last.t_source_ns]), _distance_m(end, T_end) if T_end else float("inf")
    keyframes = [
        (_distance_m(T_map_world @ truth[k.t_source_ns], odometry[k.t_source_ns]),
         _distance_m(T_map_world @ truth[k.t_source_ns], k.T_map_keyframe))
        for k in place_map.keyframes
    ]  # fmt: skip
    worst_open_m, worst_m = np.max(keyframes, axis=0)
    at = {k.number: truth[k.t_source_ns] for k in place_map.keyframes}
    loops = [link for link in place_map.links if link.loop]
    false = sum(_distance_m(at[e.from_number].between(at[e.to_number]), e.T_from_to) > FALSE_M for e in loops)
    size = len(encode_map(place_map))
    text = (
        f"{way_m:.0f} m; end error {open_m:.2f} m by odometry ({100 * open_m / way_m:.2f} %), {closed_m:.2f} m after "
        f"closure ({100 * closed_m / way_m:.2f} %); worst keyframe {worst_open_m:.2f} m before, {worst_m:.2f} m after; "
        f"{len(loops)} loop links, {false} of them false; second round {localised} of {frames} frames localised; "
        f"{len(place_map)} keyframes, {size / 1e6:.2f} MB"
    )
    ledger.add(
        "town: two rounds of 2 km", text, text=text, way_m=way_m, end_open_m=open_m, end_m=closed_m, false=int(false),
        loops=len(loops), worst_keyframe_open_m=float(worst_open_m), worst_keyframe_m=float(worst_m), bytes=size,
        localised=int(localised), frames=frames,
    )  # fmt: skip
    return place_map, at


def _distance_m(a: SE2, b: SE2) -> float:
    return float(np.hypot(a.x_m - b.x_m, a.y_m - b.y_m))


def _localise(kept: bytes, drive: _Drive, frames: Iterable[Seen]) -> list[Localisation]:
    session = MapSession(drive.recording.camera, decode_map(kept), False)
    return [session.step(estimate, image) for estimate, image in frames]


def _errors(found: Localisation, true: SE2, place_map: PlaceMap, at: dict[int, SE2]) -> Floats:
    """Error of a pose relative to the nearest keyframe; the keyframes measure the distortion of the map."""
    assert found.T_map_ego is not None
    nearest = min(place_map.keyframes, key=lambda k: _distance_m(k.T_map_keyframe, found.T_map_ego))  # type: ignore[arg-type]
    T_true = at[nearest.number].between(true)
    return T_true.between(nearest.T_map_keyframe.between(found.T_map_ego)).log()


def _evaluate(found: list[Localisation], truth: list[SE2], place_map: PlaceMap, at: dict[int, SE2]) -> dict[str, Any]:
    poses = [each for each in found if each.state is MapState.LOCALISED]
    row: dict[str, Any] = {"frames": len(found), "localised": len(poses), "false": 0}
    text = f"{len(poses)} of {len(found)} frames localised"
    if poses:
        error = np.array([_errors(each, truth[each.frame_id], place_map, at) for each in poses])
        sigma = np.array([np.sqrt(np.diag(each.cov)) for each in poses])
        off_m = np.hypot(error[:, 0], error[:, 1])
        inside = (np.abs(error) < 2.0 * sigma).mean(axis=0)
        first = next(n for n, each in enumerate(found) if each.state is MapState.LOCALISED)
        row |= {
            "median_m": float(np.median(off_m)), "worst_m": float(off_m.max()), "false": int((off_m > FALSE_M).sum()),
            "median_deg": float(np.degrees(np.median(np.abs(error[:, 2])))), "first": first,
            "within_2_sigma": inside.round(3).tolist(),
        }  # fmt: skip
        text += (
            f" (first as frame {first}), median {row['median_m']:.2f} m {row['median_deg']:.2f} deg, worst "
            f"{row['worst_m']:.2f} m, within 2 sigma {inside[0]:.2f} {inside[1]:.2f} {inside[2]:.2f}"
        )
    return row | {"text": text}


def _measure_jump(
    ledger: Ledger, drives: Path, kept: bytes, place_map: PlaceMap, at: dict[int, SE2], seen: dict[str, list[Seen]]
) -> None:
    """The car jumps to another place while the odometry continues."""
    name, other, cut = KIDNAPPED
    first, then = _Drive.open(drives / name), _Drive.open(drives / other)
    session = MapSession(first.recording.camera, decode_map(kept), False)
    for estimate, image in seen[name][:cut]:
        session.step(estimate, image)
    # From the first valid odometry of the other drive
    after = [pair for pair in seen[other] if pair[0].valid]
    T_odom = seen[name][cut - 1][0].T_world_ego @ after[0][0].T_world_ego.inverse()
    wrong_m, recovered_m = 0.0, float("nan")
    way_m, T_last = 0.0, then.truth[after[0][0].frame_id]
    for estimate, image in after:
        moved = msgspec.structs.replace(
            estimate, T_world_ego=T_odom @ estimate.T_world_ego, frame_id=estimate.frame_id + cut, epoch=0,
            t_source_ns=estimate.t_source_ns + seen[name][cut][0].t_source_ns,
        )  # fmt: skip
        found = session.step(moved, image)
        true = then.truth[estimate.frame_id]
        way_m, T_last = way_m + _distance_m(true, T_last), true
        if found.state is MapState.LOCALISED:
            error = _errors(found, true, place_map, at)
            if np.hypot(*error[:2]) > FALSE_M:
                wrong_m, recovered_m = way_m, float("nan")
            elif not recovered_m <= way_m:
                recovered_m = way_m
    text = f"localised again after {recovered_m:.0f} m; false poses for the first {wrong_m:.0f} m of them"
    ledger.add("town: kidnapped", text, text=text, recovered_m=recovered_m, wrong_m=wrong_m)
