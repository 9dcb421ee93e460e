"""Feature tracks: corners with persistent ids, tracked by pyramidal Lucas-Kanade optical flow.

Each is then aligned with the patch in which it was first seen (`templates.py`), so that its error does not grow.

The paper uses ORB corners (Sec. 3.1, static map initialisation); tracked corners are faster and have sub-pixel
accuracy. Tracking needs no network result and runs in parallel to the networks, since OpenCV releases the GIL.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.templates import CornerTemplates

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Maximum iterations and minimum step (px) of Lucas-Kanade; the alignment with the templates is more accurate
_FLOW_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 4, 0.2)
_BACKWARD_OFFSET_PX = 2.0
_MIN_ALIGNED_RATIO = 0.5  # of corners that look like their templates; below it the others are not lost
_MARGIN_PX = 2.0  # of corners to the border of the image
# Of predicted corners: depth over the assumed depth, displacement over the image width
_MIN_DEPTH_RATIO, _MAX_SHIFT_RATIO = 0.3, 0.4


class FeatureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of detection and tracking; cell sizes are for an image 1242 px wide."""

    max_tracks: Count = 450  # maximum number of tracked corners
    refill_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = (
        0.3  # fraction of lost tracks that triggers detection
    )
    cell_px: Count = 24  # cell size of detection, one new corner per cell
    min_corner_score: Positive = 8.0  # smaller eigenvalue of the structure tensor, (grey / px)^2, half image
    # Of Lucas-Kanade; a multiple of 8, the columns that OpenCV processes at once
    window_columns_px: Annotated[int, msgspec.Meta(ge=5)] = 8
    window_rows_px: Annotated[int, msgspec.Meta(ge=5)] = 20  # of Lucas-Kanade
    pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 2  # of Lucas-Kanade, in addition to the image
    max_forward_backward_px: Positive = 0.7  # forward-backward error (Kalal et al. 2010)
    start_pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = (
        4  # of Lucas-Kanade, from the predictions of a search
    )
    least_followed: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = (
        0.35  # minimum ratio of tracked corners; below this the prediction is wrong
    )
    search_pause: Count = 5  # images without a search after a search without success
    dark_mean_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 8.0  # mean below which an image is dark
    dark_std_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 4.0  # standard deviation below which an image is dark


@dataclass(frozen=True)
class Tracks:
    """Corners of one image. `ids` (N,) are ascending and never reused; `px` (N, 2) pixels (u right, v down).

    `age` (N,) is the number of images through which a corner was tracked, 0 for a new one. `flow_px` (N, 2) is the
    optical flow from the reference image, 0 for a new corner; it shows a stationary car better than `px`, whose errors
    differ between images. `dark`: too little contrast; `frozen`: identical to the previous image. In both cases the
    corners are those of the reference image.
    """

    ids: Ints
    px: Floats
    age: Ints
    flow_px: Floats
    image: NDArray[np.uint8]  # (H, W) grey
    dark: bool = False
    frozen: bool = False


Predict = Callable[[Tracks], Floats]
Search = Callable[[NDArray[np.uint8], NDArray[np.uint8], Tracks], list[Floats]]  # of both images and the tracks


class FeatureTracker:
    """Tracks corners over a stream of images of one size.

    Each image is tracked from the reference image, which `accept` sets. Images of a stationary car do not become the
    reference, so that tracks do not drift.
    """

    def __init__(self, width_px: int, height_px: int, config: FeatureConfig) -> None:
        self.width_px, self.height_px, self.config = width_px, height_px, config
        self._next_id = 0
        self._reference_image: NDArray[np.uint8] | None = None
        self._candidate: NDArray[np.uint8] | None = None
        self._last_image: NDArray[np.uint8] | None = None
        self._search_pause_left = 0  # image count
        self.drop_reference()

    @property
    def reference(self) -> Tracks:
        """The tracks in the reference image."""
        return self._reference

    def track(
        self, image: NDArray[np.uint8], predict: Predict | None = None, search: Search | None = None
    ) -> Tracks:  # fmt: skip
        """Tracks the reference's corners into `image` ((H, W) grey or (H, W, 3) BGR, uint8) and detects new ones.

        `predict` returns predicted pixels (N, 2) of the reference's tracks. Without it, or if too few tracks confirm
        it, `search` returns alternative predictions. Raises ValueError for an image of another size.
        """
        grey = self._grey(image)
        frozen = self._last_image is not None and bool(np.array_equal(grey, self._last_image))
        self._last_image = grey
        mean, std = cv2.meanStdDev(grey[::4, ::4])
        dark = float(std[0, 0]) < self.config.dark_std_grey or float(mean[0, 0]) < self.config.dark_mean_grey
        reference = self._reference
        if dark or frozen:
            self._candidate = None
            flow = np.zeros_like(reference.px)
            return Tracks(reference.ids, reference.px, reference.age, flow, grey, dark=dark, frozen=frozen)
        self._candidate, self._scale = grey, np.zeros(0)
        ids, px, age, flow = reference.ids, reference.px, reference.age, np.zeros_like(reference.px)
        if self._reference_image is not None and len(ids):
            followed, good = self._follow_reference(self._reference_image, grey, predict, search)
            ids, age, flow = ids[good], age[good] + 1, (followed - px)[good]
            px, self._scale, good = self._align(grey, ids, followed[good])
            ids, px, age, flow, self._scale = ids[good], px[good], age[good], flow[good], self._scale[good]
        fresh = self._new_corners(grey, px)
        ids = np.concatenate([ids, np.arange(self._next_id, self._next_id + len(fresh))])
        self._next_id += len(fresh)
        new = np.zeros_like(fresh)
        age, flow = np.concatenate([age, new[:, 0].astype(np.int64)]), np.concatenate([flow, new])
        return Tracks(ids, np.concatenate([px, fresh]), age, flow, grey)

    def accept(self, tracks: Tracks) -> None:
        """Makes the last tracked image the reference."""
        if self._candidate is not None:
            self._reference_image, self._reference = self._candidate, tracks
            self._templates.update(self._candidate, tracks.ids, tracks.px, self._scale)

    def drop_reference(self) -> None:
        """Drops the reference; keeps the last image for the detection of a frozen camera."""
        self._reference_image, self._candidate = None, None
        self._templates, self._scale = CornerTemplates(), np.zeros(0)
        no_ids = np.zeros(0, np.int64)
        self._reference = Tracks(no_ids, np.zeros((0, 2)), no_ids, np.zeros((0, 2)), np.zeros((0, 0), np.uint8))

    def reset(self) -> None:
        """Drops all tracks; ids are not reused."""
        fresh = FeatureTracker(self.width_px, self.height_px, self.config)
        fresh._next_id = self._next_id
        self.__dict__.update(fresh.__dict__)

    def _grey(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if image.dtype != np.uint8 or image.ndim not in (2, 3):
            raise ValueError(f"image must be (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
        if image.shape[:2] != (self.height_px, self.width_px):
            height_px, width_px = image.shape[:2]
            raise ValueError(
                f"image of {width_px}x{height_px} does not fit the camera of {self.width_px}x{self.height_px}"
            )
        if image.ndim == 3:
            return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)  # type: ignore[return-value]
        return np.array(image)  # a copy: the caller may reuse the buffer

    def _follow_reference(
        self, then: NDArray[np.uint8], now: NDArray[np.uint8], predict: Predict | None, search: Search | None
    ) -> tuple[Floats, Bools]:
        """The reference's tracks in the current image (N, 2), and which of them were tracked (N,).

        If too few were, the prediction was wrong: each corner then uses the prediction of the search with the smallest
        residual.
        """
        cfg, px = self.config, self._reference.px
        start = predict(self._reference) if predict is not None else px
        at, good, error = self._follow(then, now, px, start, cfg.pyramid_levels)
        wrong = predict is None or float(good.mean()) < cfg.least_followed
        self._search_pause_left = max(self._search_pause_left - 1, 0)
        if search is None or not wrong or (predict is not None and self._search_pause_left):
            return at, good
        guesses = [
            self._follow(then, now, px, guess, cfg.start_pyramid_levels) for guess in search(then, now, self._reference)
        ]
        best = max(guesses, key=lambda guess: int(guess[1].sum()))
        if int(best[1].sum()) < 1.2 * int(good.sum()) and predict is not None:
            self._search_pause_left = cfg.search_pause
            return at, good
        at, good, error = best
        for other, found, its_error in guesses:
            better = found & (~good | (its_error < error))
            at, error, good = np.where(better[:, None], other, at), np.where(better, its_error, error), good | found
        return at, good

    def _align(self, grey: NDArray[np.uint8], ids: Ints, px: Floats) -> tuple[Floats, Floats, Bools]:
        """Positions (N, 2) of corners aligned with their templates, their scales (N,), and which are not lost (N,).

        If few look like their templates, the patches changed too much between two images, as those of the near road do
        at a low frame rate: the others keep the flow and get new templates (scale nan).
        """
        aligned = self._templates.align(grey, ids, px)
        good = aligned.good & self._is_inside(aligned.px)
        if good.sum() > _MIN_ALIGNED_RATIO * len(good):
            return aligned.px, aligned.scale, good
        return np.where(good[:, None], aligned.px, px), np.where(good, aligned.scale, np.nan), np.ones(len(good), bool)

    def _is_inside(self, px: Floats) -> Bools:
        """(N,) whether corners (N, 2) are inside the image, with a margin."""
        u, v = px.T
        beside, below = self.width_px - _MARGIN_PX, self.height_px - _MARGIN_PX
        out: Bools = (u >= _MARGIN_PX) & (v >= _MARGIN_PX) & (u < beside) & (v < below)
        return out

    def _follow(
        self, then: NDArray[np.uint8], now: NDArray[np.uint8], px: Floats, start: Floats, levels: int
    ) -> tuple[Floats, Bools, Floats]:
        """New positions (N, 2), their validity (N,), and their residuals (N,) in grey levels."""
        cfg = self.config
        window = (cfg.window_columns_px, cfg.window_rows_px)
        here = px.astype(np.float32).reshape(-1, 1, 2)
        guess = np.where(np.isfinite(start), start, px).astype(np.float32).reshape(-1, 1, 2)
        there, ok, error = cv2.calcOpticalFlowPyrLK(
            then, now, here, guess.copy(), winSize=window, maxLevel=levels,
            criteria=_FLOW_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        # The backward pass starts with the prediction's error (limited, since it has no pyramid) instead of at the
        # corner, so that a wrong match cannot confirm itself
        off = np.clip(there - guess, -_BACKWARD_OFFSET_PX, _BACKWARD_OFFSET_PX)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            now, then, there, (here + off).astype(np.float32), winSize=window, maxLevel=0,
            criteria=_FLOW_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        forward_backward = np.abs(back - here).reshape(-1, 2).max(axis=1)
        end: Floats = there.reshape(-1, 2).astype(np.float64)
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (forward_backward < cfg.max_forward_backward_px)
        good &= self._is_inside(end)
        return end, good, np.where(good, error.ravel(), np.inf)

    def _new_corners(self, grey: NDArray[np.uint8], px: Floats) -> Floats:
        """The best corner of each cell without tracks, up to `max_tracks` in total."""
        cfg = self.config
        room = cfg.max_tracks - len(px)
        if room <= cfg.refill_share * cfg.max_tracks:
            return np.zeros((0, 2))
        half = cv2.pyrDown(grey)
        score = cv2.cornerMinEigenVal(half, 5, ksize=3) * (255.0 * 255.0)  # OpenCV's unit is (1 / 255 px)^2
        side = max(2, round(cfg.cell_px / 2 * self.width_px / 1242.0))
        edge = 4
        rows, cols = (half.shape[0] - 2 * edge) // side, (half.shape[1] - 2 * edge) // side
        if rows <= 0 or cols <= 0:
            return np.zeros((0, 2))
        cells = score[edge : edge + rows * side, edge : edge + cols * side].reshape(rows, side, cols, side)
        by_cell = cells.transpose(0, 2, 1, 3).reshape(rows * cols, side * side)
        best = by_cell.argmax(axis=1)
        value = by_cell[np.arange(rows * cols), best]
        if len(px):
            at = ((px / 2.0 - edge) / side).astype(np.int64)
            taken = at[(at[:, 0] >= 0) & (at[:, 0] < cols) & (at[:, 1] >= 0) & (at[:, 1] < rows)]
            value[taken[:, 1] * cols + taken[:, 0]] = 0.0
        order = np.argsort(-value, kind="stable")[:room]
        order = order[value[order] > cfg.min_corner_score]
        order.sort()
        v = order // cols * side + best[order] // side + edge
        u = order % cols * side + best[order] % side + edge
        return 2.0 * np.column_stack([u, v]).astype(np.float64)


def predict_corners_px(camera: Camera, ground: GroundPlane, px: Floats, step: Pose) -> Floats:
    """(N, 2) predicted pixels of corners `px` (N, 2) of unknown depth after the motion T_prev_curr `step` in metres.

    Assumes twice the road's depth below the horizon and infinity above it. A corner that would move too far keeps its
    pixel.
    """
    rays = np.column_stack([camera.to_xy(px), np.ones(len(px))])
    rho = np.maximum(-(rays @ ground.normal_cam) / camera.height_m, 0.0) * 0.5
    q = (rays - rho[:, None] * step.p) @ step.R
    out = camera.to_px(q[:, :2] / np.maximum(q[:, 2:], 0.2))
    lost = (q[:, 2] < _MIN_DEPTH_RATIO) | (np.abs(out - px) > _MAX_SHIFT_RATIO * camera.width_px).any(axis=1)
    out[lost] = px[lost]
    return out
