"""Feature tracks: corners with persistent ids, tracked from image to image by pyramidal Lucas-Kanade optical flow.

The paper takes ORB corners (Sec. 3.1, static map initialisation); tracked corners give the same persistent points at
sub-pixel accuracy and a fraction of the time. No network result is needed, so tracking runs beside the networks
(OpenCV releases the GIL).
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

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Lucas-Kanade stops after so many iterations or at a smaller step (px); the backward pass need not be exact
_FORWARD_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.03)
_BACK_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 6, 0.1)
_BACKWARD_OFFSET_PX = 2.0
# Of predicted corners: the smallest depth, as a share of the assumed one, and the largest shift, of the image's width
_MIN_DEPTH_REL, _MAX_SHIFT_REL = 0.3, 0.4


class FeatureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How corners are found and followed; lengths in pixels; cells are for an image 1242 px wide."""

    max_tracks: Count = 450  # corners that are tracked at once
    refill_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.3  # of them lost, until new ones are detected
    cell_px: Count = 24  # at most one new corner in a cell of this size
    min_corner_score: Positive = 8.0  # smaller eigenvalue of the structure tensor, (grey / px)^2, half image
    # Of Lucas-Kanade: OpenCV processes eight columns at once, so that a ninth costs as much as eight more
    window_columns_px: Annotated[int, msgspec.Meta(ge=5)] = 8
    window_rows_px: Annotated[int, msgspec.Meta(ge=5)] = 20  # of Lucas-Kanade
    pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 2  # of Lucas-Kanade, beside the image itself
    max_forward_backward_px: Positive = 0.7  # forward-backward error (Kalal et al. 2010)
    start_pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = (
        4  # from a predicted position that was searched for
    )
    least_followed: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = (
        0.35  # of the corners; fewer: the prediction is wrong
    )
    search_pause: Count = 5  # images after a search that found no better prediction
    max_residual_grey: Positive = 14.0  # mean absolute difference of the windows (after LK), grey levels
    dark_mean_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 8.0  # an image that is darker on average is dark
    dark_std_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 4.0  # and so is one with less contrast


@dataclass(frozen=True)
class Tracks:
    """Corners of one image. `ids` (N,) ascending and never used twice; `px` (N, 2) pixels (u right, v down).

    `age` (N,) counts the images that a corner was tracked through, 0 for a new one. `dark`: too little contrast;
    `frozen`: bit for bit the image before. In both cases nothing was tracked and the corners are the last ones.
    """

    ids: Ints
    px: Floats
    age: Ints
    image: NDArray[np.uint8]  # (H, W) grey
    dark: bool = False
    frozen: bool = False


Predict = Callable[[Tracks], Floats]
Search = Callable[[NDArray[np.uint8], NDArray[np.uint8], Tracks], list[Floats]]  # by both images and the tracks


class FeatureTracker:
    """Tracks corners over a stream of images of one size.

    The next image is tracked from the reference image, which `accept` sets. A dark image or one of a stationary car is
    tracked but does not become the reference, so that tracks are neither lost nor drift.
    """

    def __init__(self, width_px: int, height_px: int, config: FeatureConfig) -> None:
        self.width_px, self.height_px, self.config = width_px, height_px, config
        self._next_id = 0
        self._reference_image: NDArray[np.uint8] | None = None
        self._candidate: NDArray[np.uint8] | None = None
        self._last_image: NDArray[np.uint8] | None = None
        self._search_pause_left = 0  # images
        self.drop_reference()

    @property
    def reference(self) -> Tracks:
        """The tracks in the reference image."""
        return self._reference

    def track(
        self, image: NDArray[np.uint8], predict: Predict | None = None, search: Search | None = None
    ) -> Tracks:  # fmt: skip
        """Tracks the reference's corners into `image` ((H, W) grey or (H, W, 3) BGR, uint8) and detects new ones.

        `predict` gives the predicted pixels (N, 2) of the reference's tracks. Without it, or where too few tracks
        confirm it, `search` gives alternative predictions. Raises ValueError for another size.
        """
        grey = self._grey(image)
        frozen = self._last_image is not None and bool(np.array_equal(grey, self._last_image))
        self._last_image = grey
        mean, std = cv2.meanStdDev(grey[::4, ::4])
        dark = float(std[0, 0]) < self.config.dark_std_grey or float(mean[0, 0]) < self.config.dark_mean_grey
        reference = self._reference
        if dark or frozen:
            self._candidate = None
            return Tracks(reference.ids, reference.px, reference.age, grey, dark=dark, frozen=frozen)
        self._candidate = grey
        ids, px, age = reference.ids, reference.px, reference.age
        if self._reference_image is not None and len(ids):
            followed, good = self._follow_reference(self._reference_image, grey, predict, search)
            ids, px, age = ids[good], followed[good], age[good] + 1
        fresh = self._new_corners(grey, px)
        ids = np.concatenate([ids, np.arange(self._next_id, self._next_id + len(fresh))])
        self._next_id += len(fresh)
        return Tracks(ids, np.concatenate([px, fresh]), np.concatenate([age, np.zeros(len(fresh), np.int64)]), grey)

    def accept(self, tracks: Tracks) -> None:
        """Makes the image last tracked the reference of the next one."""
        if self._candidate is not None:
            self._reference_image, self._reference = self._candidate, tracks

    def drop_reference(self) -> None:
        """The next image is tracked from none; the last image is kept for the test of a frozen camera."""
        self._reference_image, self._candidate = None, None
        no_ids = np.zeros(0, np.int64)
        self._reference = Tracks(no_ids, np.zeros((0, 2)), no_ids, np.zeros((0, 0), np.uint8))

    def reset(self) -> None:
        """Forgets all tracks; ids go on counting."""
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
        """The reference's tracks in the present image (N, 2), and which of them were tracked (N,).

        Where too few were, the prediction was wrong: each corner then takes the searched prediction with the smallest
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

    def _follow(
        self, then: NDArray[np.uint8], now: NDArray[np.uint8], px: Floats, start: Floats, levels: int
    ) -> tuple[Floats, Bools, Floats]:
        """New positions (N, 2), which of them are valid (N,), and the residuals there (N,), grey levels."""
        cfg = self.config
        window = (cfg.window_columns_px, cfg.window_rows_px)
        here = px.astype(np.float32).reshape(-1, 1, 2)
        guess = np.where(np.isfinite(start), start, px).astype(np.float32).reshape(-1, 1, 2)
        there, ok, error = cv2.calcOpticalFlowPyrLK(
            then, now, here, guess.copy(), winSize=window, maxLevel=levels,
            criteria=_FORWARD_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        # The backward pass starts off by the prediction's own error, as far as it reaches without a pyramid, and not at
        # the corner itself: a wrong match must not confirm itself.
        off = np.clip(there - guess, -_BACKWARD_OFFSET_PX, _BACKWARD_OFFSET_PX)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            now, then, there, (here + off).astype(np.float32), winSize=window, maxLevel=0,
            criteria=_BACK_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        forward_backward = np.abs(back - here).reshape(-1, 2).max(axis=1)
        end: Floats = there.reshape(-1, 2).astype(np.float64)
        margin = 2.0
        inside = (
            (end >= margin).all(axis=1) & (end[:, 0] < self.width_px - margin) & (end[:, 1] < self.height_px - margin)
        )
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (forward_backward < cfg.max_forward_backward_px) & inside
        good &= (error.ravel() < cfg.max_residual_grey) & np.isfinite(end).all(axis=1)
        return end, good, np.where(good, error.ravel(), np.inf)

    def _new_corners(self, grey: NDArray[np.uint8], px: Floats) -> Floats:
        """The best corner of each cell that holds no track, best first, until `max_tracks` are reached."""
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
    """(N, 2) of corners `px` (N, 2) of unknown depth, after the motion T_prev_curr of `step` in metres.

    Below the horizon a corner is assumed at twice the road's depth, above it at infinity. One that would leave the
    image, or move too far, is predicted where it was.
    """
    rays = np.column_stack([camera.to_xy(px), np.ones(len(px))])
    rho = np.maximum(-(rays @ ground.normal_cam) / camera.height_m, 0.0) * 0.5
    q = (rays - rho[:, None] * step.p) @ step.R
    out = camera.to_px(q[:, :2] / np.maximum(q[:, 2:], 0.2))
    lost = (q[:, 2] < _MIN_DEPTH_REL) | (np.abs(out - px) > _MAX_SHIFT_REL * camera.width_px).any(axis=1)
    out[lost] = px[lost]
    return out
