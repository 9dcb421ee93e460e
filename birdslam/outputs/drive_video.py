"""Draws the video of a drive: the camera image with boxes, beside the bird's-eye view. All arrays are BGR."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats, Image
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.outline import FROM_M, lane_px, line_px
from birdslam.outputs.bev_picture import (
    EGO,
    EGO_FRONT_M,
    EGO_LENGTH_M,
    EGO_WIDTH_M,
    FAINT,
    GRID,
    INK,
    LANDMARK,
    LANE,
    LINE,
    PAPER,
    colour_of,
    number_of,
)
from birdslam.outputs.drive_files import ResultsError
from birdslam.types import Estimate, Lanes, LineKind, MapUpdate, RoadUser

MAX_SCALE, MAX_WIDTH_PX = 1.5, 1280  # of the resized camera image
STRIP_PX, PANEL_PX = 96, 368  # height of the text below the image, width of the bird's-eye view
AHEAD_M, BEHIND_M = 50.0, 10.0  # extent of the bird's-eye view
LANE_ALPHA = 0.18  # of the ego lane over the image
BOX_HEIGHT_M = 1.5  # if the height is unknown
MAX_POINTS, MAX_POSES = 12_000, 400
SHIFT = 4  # fractional bits of OpenCV coordinates
RING_M = 10.0
FONT = cv2.FONT_HERSHEY_SIMPLEX
SUFFIX, CODEC = ".mp4", "mp4v"  # the codec that every build of OpenCV can write
MAX_VIDEO_RATE_HZ = 20.0  # of faster cameras, every second or third frame is drawn


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


class SideBySide:
    """Draws one picture per frame."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        #: pixels of the drawn camera image per pixel of the camera
        self.scale = min(MAX_SCALE, MAX_WIDTH_PX / camera.width_px)
        self._image_px = (round(camera.width_px * self.scale), round(camera.height_px * self.scale))
        self.size_px = self._image_px[0] + PANEL_PX, self._image_px[1] + STRIP_PX  # width, height; both even
        self.size_px = self.size_px[0] // 2 * 2, self.size_px[1] // 2 * 2
        self._paper: Image = np.full((self.size_px[1], self.size_px[0], 3), _bgr(PAPER), np.uint8)
        self._per_m = self.size_px[1] / (AHEAD_M + BEHIND_M)
        self._epoch: int | None = None
        self._lanes: deque[tuple[float, float]] = deque(maxlen=MAX_POINTS)
        self._landmarks: deque[tuple[float, float]] = deque(maxlen=MAX_POINTS)
        self._path: deque[tuple[float, float]] = deque(maxlen=MAX_POSES)

    def add_map(self, update: MapUpdate) -> None:
        """Adds points in world of the epoch of the update."""
        self._enter(update.epoch)
        self._lanes.extend(update.lanes_m)
        self._landmarks.extend(update.landmarks_m)

    def draw(self, image: Image, estimate: Estimate, true_outlines: Sequence[Floats], words: Sequence[str]) -> Image:
        """Returns a picture (H, W, 3) of `size_px` from the undistorted `image`, (H, W) grey or (H, W, 3) BGR.

        `true_outlines` are footprints (4, 2) in ego, drawn as white outlines.
        """
        self._enter(estimate.epoch)
        self._path.append((estimate.T_world_ego.x_m, estimate.T_world_ego.y_m))
        canvas = self._paper.copy()
        width_px, height_px = self._image_px
        canvas[:height_px, :width_px] = self._camera_view(image, estimate)
        for line, text in enumerate(words):
            at = 14, height_px + 24 + 24 * line
            colour = _bgr(INK if line == 0 else FAINT)
            cv2.putText(canvas, text, at, FONT, 0.5, colour, 1, cv2.LINE_AA)
        canvas[:, width_px:] = self._from_above(estimate, true_outlines)[:, : canvas.shape[1] - width_px]
        return canvas

    def _enter(self, epoch: int) -> None:
        if epoch != self._epoch:  # the transform between the two worlds is unknown
            self._lanes.clear()
            self._landmarks.clear()
            self._path.clear()
            self._epoch = epoch

    def _camera_view(self, image: Image, estimate: Estimate) -> Image:
        image = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
        view: Image = cv2.resize(image, self._image_px, interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
        ground = self._camera.ground
        if estimate.ground is not None:
            ground = GroundPlane(estimate.ground.height_m, estimate.ground.pitch_rad, estimate.ground.roll_rad)
        solids: list[tuple[RoadUser, Floats, Floats]] = []  # footprint in ego, eight corners in pixels
        for vehicle in estimate.road_users:
            if not vehicle.in_sight:
                continue
            foot = outline(estimate.T_world_ego.between(vehicle.T_world_vehicle), vehicle.length_m, vehicle.width_m)
            corners = np.vstack(
                [np.column_stack([foot, np.full(4, z_m)]) for z_m in (0.0, vehicle.height_m or BOX_HEIGHT_M)]
            )
            if corners[:, 0].min() < 1.0:  # partly behind the image plane
                continue
            px = (bev.ego_to_pixel(self._camera, ground, corners) + 0.5) * self.scale - 0.5
            solids.append((vehicle, foot, px))
        if estimate.lanes is not None:
            before = view.copy()
            self._draw_lanes(view, ground, estimate.lanes)
            in_front = np.zeros(view.shape[:2], np.uint8)  # road users hide the lanes behind them
            for _, _, px in solids:
                cv2.fillConvexPoly(in_front, cv2.convexHull(_fixed(px)), 1, cv2.LINE_8, SHIFT)
            cv2.copyTo(before, in_front, view)
        for vehicle, foot, px in solids:
            low, high = _fixed(px[:4]), _fixed(px[4:])
            colour = _colour_of(vehicle)
            cv2.polylines(view, [low, high], True, colour, 1, cv2.LINE_AA, SHIFT)
            for a, b in zip(low.tolist(), high.tolist(), strict=True):
                cv2.line(view, a, b, colour, 1, cv2.LINE_AA, SHIFT)
            at = np.clip(px[4:].min(axis=0), -1e4, 1e4)
            text = f"{name_of(vehicle)}  {foot[:, 0].min():.0f} m"
            cv2.putText(view, text, (int(at[0]), int(at[1]) - 4), FONT, 0.4, colour, 1, cv2.LINE_AA)
        return view

    def _draw_lanes(self, view: Image, ground: GroundPlane, lanes: Lanes) -> None:
        """Shades the ego lane and draws lane lines and, dimmer, road edges, beyond the bonnet."""
        from_m = max(lanes.road_from_m, FROM_M)
        ground = GroundPlane(ground.height_m, ground.pitch_rad + lanes.tilt_rad, ground.roll_rad)
        bend = lanes.vertical_curvature_per_m
        if lanes.ego is not None:
            area = (lane_px(self._camera, ground, lanes.ego, from_m, bend) + 0.5) * self.scale - 0.5
            shade = view.copy()
            if len(area) > 2:
                cv2.fillPoly(shade, [_fixed(area)], _bgr(EGO), cv2.LINE_AA, SHIFT)
            cv2.addWeighted(shade, LANE_ALPHA, view, 1.0 - LANE_ALPHA, 0.0, view)
        for line in lanes.lines:
            px = (line_px(self._camera, ground, line, from_m, bend) + 0.5) * self.scale - 0.5
            colour = _bgr(FAINT if line.kind is LineKind.EDGE else LINE)
            cv2.polylines(view, [_fixed(px)], False, colour, 2, cv2.LINE_AA, SHIFT)

    def _from_above(self, estimate: Estimate, true_outlines: Sequence[Floats]) -> Image:
        panel = self._paper[:, :PANEL_PX].copy()
        T_ego_world = estimate.T_world_ego.inverse()
        origin = self._panel_px(np.zeros((1, 2)))[0]
        for ring in range(1, int(AHEAD_M / RING_M) + 1):
            radius = round(ring * RING_M * self._per_m)
            cv2.circle(panel, (int(origin[0]), int(origin[1])), radius, _bgr(GRID), 1, cv2.LINE_AA)
        for points, colour in ((self._landmarks, LANDMARK), (self._lanes, LANE)):
            if points:
                at = np.rint(self._panel_px(T_ego_world @ np.array(points))).astype(np.int64)
                at = at[((at >= 0) & (at < [PANEL_PX, self.size_px[1]])).all(axis=1)]
                panel[at[:, 1], at[:, 0]] = _bgr(colour)
        for line in () if estimate.lanes is None else estimate.lanes.lines:
            x_m = np.arange(max(-BEHIND_M, line.seen_from_m), min(line.to_m, AHEAD_M), 2.0)
            at_m = np.column_stack([x_m, [line.y_m(x) for x in x_m.tolist()]])
            colour = FAINT if line.kind is LineKind.EDGE else LINE
            cv2.polylines(panel, [_fixed(self._panel_px(at_m))], False, _bgr(colour), 1, cv2.LINE_AA, SHIFT)
        path = _fixed(self._panel_px(T_ego_world @ np.array(self._path)))
        cv2.polylines(panel, [path], False, _bgr(EGO), 2, cv2.LINE_AA, SHIFT)
        for fan in estimate.hidden:
            cv2.polylines(
                panel, [_fixed(self._panel_px(np.array(fan.corners_m)))], True, _bgr(FAINT), 1, cv2.LINE_AA, SHIFT
            )
        for vehicle in estimate.road_users:
            pose = estimate.T_world_ego.between(vehicle.T_world_vehicle)
            px = self._panel_px(outline(pose, vehicle.length_m, vehicle.width_m))
            if vehicle.in_sight:
                cv2.fillPoly(panel, [_fixed(px)], _colour_of(vehicle), cv2.LINE_AA, SHIFT)
            cv2.polylines(panel, [_fixed(px)], True, _colour_of(vehicle), 1, cv2.LINE_AA, SHIFT)
            u, v = px.max(axis=0)
            if 0 <= u < PANEL_PX and 0 <= v < len(panel):
                cv2.putText(panel, name_of(vehicle), (int(u) + 2, int(v)), FONT, 0.35, _bgr(INK), 1, cv2.LINE_AA)
        for true in true_outlines:
            cv2.polylines(panel, [_fixed(self._panel_px(true))], True, (255, 255, 255), 1, cv2.LINE_AA, SHIFT)
        own = outline(SE2(EGO_FRONT_M - EGO_LENGTH_M / 2.0, 0.0, 0.0), EGO_LENGTH_M, EGO_WIDTH_M)
        cv2.fillPoly(panel, [_fixed(self._panel_px(own))], _bgr(EGO), cv2.LINE_AA, SHIFT)
        return panel

    def _panel_px(self, points: Floats) -> Floats:
        """Converts points (N, 2) from ego to panel pixels: x up, y left."""
        out: Floats = np.column_stack(
            [PANEL_PX / 2.0 - points[:, 1] * self._per_m, (AHEAD_M - points[:, 0]) * self._per_m]
        )
        return out


class DriveVideo:
    """Draws the frames of a drive. As a context manager, it completes the file if a run fails.

    `frames` are (frame_id, source time in ns, undistorted image or None) in order; they are read up to the last
    estimate and may be endless. A frame without an estimate shows the previous one. `truth` returns the true footprints
    (4, 2) in ego of a frame. Raises ResultsError if the file can't be written.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        rate_hz: float,
        frames: Iterator[tuple[int, int, Image | None]],
        truth: Callable[[int], Sequence[Floats]] | None = None,
    ) -> None:
        self._view = SideBySide(camera)
        self._every = frames_per_picture(rate_hz)
        self._frames, self._truth = frames, truth
        self._next: tuple[int, int, Image | None] | None = None
        self._estimate: Estimate | None = None
        self._writer = _open_writer(path, rate_hz / self._every, self._view.size_px)
        self.drawn_frame = -1

    def add(self, estimate: Estimate) -> None:
        """Draws the frames before this estimate."""
        self._draw_until(estimate.frame_id)
        self._estimate = estimate

    def add_map(self, update: MapUpdate) -> None:
        """Adds the new map points of the latest estimate."""
        self._view.add_map(update)

    def finish(self) -> None:
        """Draws the frame of the last estimate and closes the file."""
        if self._estimate is not None:
            self._draw_until(self._estimate.frame_id + 1)
        self._writer.release()

    def _draw_until(self, end: int) -> None:
        """Draws all frames before frame `end`."""
        while True:
            self._next = next(self._frames, None) if self._next is None else self._next
            if self._next is None or self._next[0] >= end:
                return
            frame_id, t_ns, image = self._next
            self._next, self.drawn_frame = None, frame_id
            if self._estimate is not None and image is not None and frame_id % self._every == 0:
                self._writer.write(self._picture(t_ns, image, self._estimate))

    def _picture(self, t_ns: int, image: Image, estimate: Estimate) -> Image:
        seen = sum(vehicle.in_sight for vehicle in estimate.vehicles)
        people = sum(person.in_sight for person in estimate.people)
        white = "white outlines: truth, " if self._truth else ""
        words = (
            f"BirdSLAM  {t_ns * 1e-9:5.1f} s  frame {estimate.frame_id}  {seen} vehicles, {people} people in sight",
            f"right: from above, 10 m rings; filled: estimates, {white}cyan: ego",
            " ".join(status.value for status in estimate.status) or "no remarks",
        )
        truth = self._truth(estimate.frame_id) if self._truth else ()
        return self._view.draw(image, estimate, truth, words)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self._writer.release()


def frames_per_picture(rate_hz: float) -> int:
    """Returns how many frames of a camera a picture of its video stands for."""
    return math.ceil(rate_hz / MAX_VIDEO_RATE_HZ)


def check_video(path: Path, camera: Camera, rate_hz: float) -> None:
    """Raises ResultsError if a video of this camera can't be written to `path`. Keeps an existing file.

    Creates missing parent directories.
    """
    if path.suffix != SUFFIX:
        raise ResultsError(f"video {path}: expected FILE{SUFFIX}")
    if path.is_dir():
        raise ResultsError(f"video {path}: is a directory")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultsError(f"video {path}: {path.parent} can't be created: {error.strerror}") from None
    probe = path.with_name(f".{path.stem}.probe{SUFFIX}")
    try:
        probe.touch()
        _open_writer(probe, rate_hz, SideBySide(camera).size_px).release()
    except OSError as error:
        raise ResultsError(f"video {path}: {error.strerror}") from None
    finally:
        probe.unlink(missing_ok=True)


def _open_writer(path: Path, rate_hz: float, size_px: tuple[int, int]) -> cv2.VideoWriter:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), rate_hz, size_px)
    if not writer.isOpened():
        raise ResultsError(f"video {path}: this build of OpenCV can't write {CODEC} there")
    return writer


def outline(pose: SE2, length_m: float, width_m: float) -> Floats:
    """Returns the corners (4, 2) of a footprint centred at `pose`."""
    x_m, y_m = length_m / 2.0, width_m / 2.0
    return pose @ np.array([[x_m, y_m], [x_m, -y_m], [-x_m, -y_m], [-x_m, y_m]])


def name_of(user: RoadUser) -> str:
    """Returns the number, preceded by the class unless it is a car."""
    number = number_of(user.vehicle)
    return f"{number}" if user.label == "car" else f"{user.label} {number}"


def _colour_of(vehicle: RoadUser) -> tuple[int, int, int]:
    red, green, blue = (round(255 * share) for share in colour_of(vehicle.vehicle))
    return blue, green, red


def _fixed(px: Floats) -> NDArray[np.int32]:
    return np.rint(np.clip(px, -1e5, 1e5) * 2**SHIFT).astype(np.int32)
