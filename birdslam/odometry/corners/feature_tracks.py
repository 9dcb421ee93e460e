"""Track keeping: corners with persistent ids, followed from image to image by pyramidal Lucas-Kanade.

The paper takes stable ORB corners (Sec. 3.1, static map initialisation); corners that optical flow can follow give the
same persistent points at sub-pixel accuracy and a fraction of the time. Needs no network result, so it can run beside
the networks (OpenCV releases the GIL).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# When Lucas-Kanade ends: after so many steps, or at a shorter one (px); the way back need not be exact
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.03)
_BACK_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 6, 0.1)
_BACK_OFF_PX = 2.0


class FeatureConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How corners are found and followed; lengths in pixels; cells are for an image 1242 px wide."""

    max_tracks: Count = 450  # corners that are followed at once
    refill_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.3  # of them gone, until new ones are looked for
    cell_px: Count = 24  # at most one new corner in a cell of this size
    min_corner_score: Positive = 8.0  # smaller eigenvalue of the structure tensor, (grey / px)^2, half image
    # Of Lucas-Kanade: OpenCV's loop over a row takes eight columns at once, and a ninth costs as much as eight more
    window_columns_px: Annotated[int, msgspec.Meta(ge=5)] = 8
    window_rows_px: Annotated[int, msgspec.Meta(ge=5)] = 20  # of Lucas-Kanade
    pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 2  # of Lucas-Kanade, beside the image itself
    max_roundtrip_px: Positive = 0.7  # forward and back again must end where it began
    start_pyramid_levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4  # from a guess that was searched for
    least_followed: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.35  # of the corners; fewer: a wrong guess
    search_pause: Count = 5  # images after a search that found no better
    max_residual_grey: Positive = 14.0  # mean absolute difference of the windows (after LK), grey levels
    dark_mean_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 8.0  # an image that is darker on average is dark
    dark_std_grey: Annotated[float, msgspec.Meta(ge=0.0)] = 4.0  # and so is one with less contrast


@dataclass(frozen=True)
class Tracks:
    """Corners of one image. `ids` (N,) ascending and never used twice; `px` (N, 2) pixels (u right, v down).

    `age` (N,) counts the images in which a corner was followed, 0 for one just found. `dark` and `frozen` say that the
    image shows nothing, or is bit for bit the one before; then nothing was followed and the corners are the last ones.
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
    """Keeps tracks over a stream of images of one size.

    `accept` names the image that the next one is followed from: a dark image, or one of a standing car, is looked at
    and not stepped onto, so that neither costs a track or lets one creep.
    """

    def __init__(self, width_px: int, height_px: int, config: FeatureConfig) -> None:
        self.width_px, self.height_px, self.config = width_px, height_px, config
        self._next_id = 0
        self._base_image: NDArray[np.uint8] | None = None
        self._candidate: NDArray[np.uint8] | None = None
        self._last_image: NDArray[np.uint8] | None = None
        self._search_in = 0  # images
        self.leave_base()

    @property
    def base(self) -> Tracks:
        """The tracks in the image that the next one is followed from."""
        return self._base

    def track(
        self, image: NDArray[np.uint8], predict: Predict | None = None, search: Search | None = None
    ) -> Tracks:  # fmt: skip
        """Follows the base's corners into `image` ((H, W) grey or (H, W, 3) BGR, uint8) and finds new ones.

        `predict` gives the pixels (N, 2) where the base's tracks are expected; where there is none, or the image does
        not bear it out, `search` gives several such guesses. Raises ValueError for another size.
        """
        grey = self._grey(image)
        frozen = self._last_image is not None and bool(np.array_equal(grey, self._last_image))
        self._last_image = grey
        mean, std = cv2.meanStdDev(grey[::4, ::4])
        dark = float(std[0, 0]) < self.config.dark_std_grey or float(mean[0, 0]) < self.config.dark_mean_grey
        base = self._base
        if dark or frozen:
            self._candidate = None
            return Tracks(base.ids, base.px, base.age, grey, dark=dark, frozen=frozen)
        self._candidate = grey
        ids, px, age = base.ids, base.px, base.age
        if self._base_image is not None and len(ids):
            followed, good = self._follow_base(self._base_image, grey, predict, search)
            ids, px, age = ids[good], followed[good], age[good] + 1
        fresh = self._new_corners(grey, px)
        ids = np.concatenate([ids, np.arange(self._next_id, self._next_id + len(fresh))])
        self._next_id += len(fresh)
        return Tracks(ids, np.concatenate([px, fresh]), np.concatenate([age, np.zeros(len(fresh), np.int64)]), grey)

    def accept(self, tracks: Tracks) -> None:
        """Makes the image last tracked the base of the next one."""
        if self._candidate is not None:
            self._base_image, self._base = self._candidate, tracks

    def leave_base(self) -> None:
        """The next image is followed from none; what it is compared with to be found frozen stays."""
        self._base_image, self._candidate = None, None
        self._base = Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 0), np.uint8))

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

    def _follow_base(
        self, then: NDArray[np.uint8], now: NDArray[np.uint8], predict: Predict | None, search: Search | None
    ) -> tuple[Floats, Bools]:
        """The base's tracks in the present image, and which of them were found there.

        Where too few were, the guess was wrong. Of several that are searched for each corner takes the one from
        which it comes to what looks most alike.
        """
        cfg, px = self.config, self._base.px
        start = predict(self._base) if predict is not None else px
        at, good, error = self._follow(then, now, px, start, cfg.pyramid_levels)
        wrong = predict is None or float(good.mean()) < cfg.least_followed
        self._search_in = max(self._search_in - 1, 0)
        if search is None or not wrong or (predict is not None and self._search_in):
            return at, good
        guesses = [
            self._follow(then, now, px, guess, cfg.start_pyramid_levels) for guess in search(then, now, self._base)
        ]
        best = max(guesses, key=lambda guess: int(guess[1].sum()))
        if int(best[1].sum()) < 1.2 * int(good.sum()) and predict is not None:
            self._search_in = cfg.search_pause
            return at, good
        at, good, error = best
        for other, found, its_error in guesses:
            better = found & (~good | (its_error < error))
            at, error, good = np.where(better[:, None], other, at), np.where(better, its_error, error), good | found
        return at, good

    def _follow(
        self, then: NDArray[np.uint8], now: NDArray[np.uint8], px: Floats, start: Floats, levels: int
    ) -> tuple[Floats, Bools, Floats]:
        """Where corners came to (N, 2), whether that can be believed (N,), and the residual there (N,), grey levels."""
        cfg = self.config
        window = (cfg.window_columns_px, cfg.window_rows_px)
        here = px.astype(np.float32).reshape(-1, 1, 2)
        guess = np.where(np.isfinite(start), start, px).astype(np.float32).reshape(-1, 1, 2)
        there, ok, error = cv2.calcOpticalFlowPyrLK(
            then, now, here, guess.copy(), winSize=window, maxLevel=levels,
            criteria=_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        # The way back starts off by the guess's own error, as far as it reaches without a pyramid, and not at the
        # answer: a wrong match must not confirm itself.
        off = np.clip(there - guess, -_BACK_OFF_PX, _BACK_OFF_PX)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            now, then, there, (here + off).astype(np.float32), winSize=window, maxLevel=0,
            criteria=_BACK_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
        )  # fmt: skip  # type: ignore[call-overload]
        roundtrip = np.abs(back - here).reshape(-1, 2).max(axis=1)
        end: Floats = there.reshape(-1, 2).astype(np.float64)
        margin = 2.0
        inside = (
            (end >= margin).all(axis=1) & (end[:, 0] < self.width_px - margin) & (end[:, 1] < self.height_px - margin)
        )
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (roundtrip < cfg.max_roundtrip_px) & inside
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
