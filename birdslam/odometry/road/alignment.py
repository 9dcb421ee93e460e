"""Direct alignment of the road in two images: scale, pitch, roll and curvature by photometric least squares.

Warps the past image by the homography of the road plane, K (R + lambda t n(pitch, roll)^T / H) K^-1, where lambda is
the factor on the length. A curved road is s^2 / 2 times `curvature` (1/m, > 0 in a sag) above its tangent plane at the
camera's foot; the tilt is against that plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, plane_normal
from birdslam.geometry.pose import Pose, rotation_exp, rotation_log
from birdslam.geometry.rolling_shutter import RollingShutter
from birdslam.odometry.median import upper_median
from birdslam.odometry.road.fit import MOTION, ROAD, Gradients, RoadFit, fit_without_prior
from birdslam.odometry.road.length_information import OTHER_LENGTHS_LOG, length_information
from birdslam.odometry.road.road_image import Grey, RoadImage

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_MARGIN_PX = 4  # from the image border, for the warp and the smoothing
_MAX_STEP = np.array([0.1, 0.1, 0.1, 0.005] + [0.1] * MOTION)  # of one iteration
# Scale of each state in the convergence test
_STEP_UNITS = np.array([1.0, 1.0, 1.0, 0.05] + [3.0] * MOTION)
_MIN_DEPTH_M, _MIN_VISIBLE_M = 1e-3, 0.05  # along the past camera's axis
_MIN_DETERMINANT = 1e-3  # of the map from the current to the past image; limits its inverse
_EMPTY = np.zeros(0)
_LENGTH = np.eye(ROAD + MOTION)[0]
_READOUT_ITERATIONS = 2  # fixed-point iterations for the readout row of a sample
_MIN_DISCRIMINANT_RATIO = 0.01  # for rays over a crest, which miss the parabola


class RoadAlignConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the samples, the optimization and its uncertainty."""

    near_m: Positive = 4.0  # near end of the road strip
    far_m: Positive = 22.0  # far end of the road strip
    half_width_m: Positive = 3.2  # of the strip; beyond are crown, kerb and parked cars
    lane_half_width_m: Positive = 2.0  # of the strip without a road mask: the car's own lane
    max_samples: Annotated[int, msgspec.Meta(ge=200)] = 2600  # maximum number of aligned pixels
    min_samples: Annotated[int, msgspec.Meta(ge=50)] = 250  # minimum number of aligned pixels
    contrast_window_px: Annotated[int, msgspec.Meta(ge=3)] = 13  # window of the brightness and contrast normalisation
    contrast_floor_grey: Positive = 2.0  # added to the contrast, to limit noise on smooth road
    # Effective over actual samples, since errors of neighbouring pixels and of the road's shape are correlated
    effective_sample_fraction: Positive = 0.04
    sigma_rotation_rad: Positive = 0.0005  # minimum 1-sigma of the odometry's relative rotation
    sigma_direction_rad: Positive = 0.007  # minimum 1-sigma of the direction of its translation
    max_iterations: Annotated[int, msgspec.Meta(ge=3)] = 7  # of the optimization
    coarse_step: Annotated[int, msgspec.Meta(ge=1)] = 4  # the coarse stage uses each n-th sample
    coarse_tolerance: Positive = 2e-3  # convergence threshold of the coarse stage
    tolerance: Positive = 1e-3  # convergence threshold of the fine stage


@dataclass(frozen=True)
class _View:
    """Samples of the current image: rays (3, N), rays rotated to the past camera (3, N), grey values (N,).

    For a rolling shutter: `turning` (3, N) is the change of the rotated rays over the time between both images, and
    `late` (N,) the readout time of each sample, as a fraction of that time.
    """

    rays: Floats
    turned: Floats
    grey: Floats
    turning: Floats
    late: Floats
    readout_share: float = 0.0  # readout time of an image, as a fraction of that time

    def thinned(self, step: int) -> _View:
        """Subsamples by `step`."""
        parts = self.rays, self.turned, self.grey, self.turning, self.late
        rays, turned, grey, turning, late = (np.ascontiguousarray(part[..., ::step]) for part in parts)
        return _View(rays, turned, grey, turning, late, self.readout_share)


@dataclass(frozen=True)
class _Places:
    """Samples projected to the past camera: (x, y) at z = 1, (N,) each, and their inverse depth `by_z` there.

    `rho` is the inverse depth in the current camera, `root` the square root in its solution. `motion` is the fraction
    of the motion between both images that a sample sees: 1 for a global shutter, else (N,).
    """

    x: Floats
    y: Floats
    by_z: Floats
    rho: Floats
    root: Floats
    motion: Floats | float


def _brightness(past: Floats, present: Floats) -> tuple[float, float]:
    """Bias and gain from the current grey values (N,) to the past ones."""
    gain = ((past - past.mean()) * (present - present.mean())).mean() / max(present.var(), 1e-6)
    gain = float(np.clip(gain, 0.5, 2.0))
    return float(past.mean() - gain * present.mean()), gain


def _correlation(past: Floats, present: Floats, weights: Floats) -> float:
    w = weights / weights.sum()
    a, b = past - w @ past, present - w @ present
    return float((w * a) @ b / np.sqrt(max(float((w * a) @ a * ((w * b) @ b)), 1e-12)))


def _translation(T_past_present: Pose, x: Floats) -> Floats:
    """(3,) translation in metres, with the error of its direction from the state x."""
    t, (right, down) = T_past_present.p, x[ROAD + 3 : ROAD + MOTION]
    out: Floats = np.exp(x[0]) * (t + float(np.linalg.norm(t)) * np.array([right, down, 0.0]))
    return out


class RoadAligner:
    """Aligns two images of the road of one camera."""

    def __init__(self, camera: Camera, config: RoadAlignConfig) -> None:
        self.camera, self.config = camera, config
        self._shutter = RollingShutter(camera)
        # The highest row that can show road at far_m, with the camera pitched up by 3 degrees
        horizon = camera.cy_px + camera.fy_px * (camera.height_m / config.far_m - 0.05)
        self.top_px = int(np.clip(horizon, 0, camera.height_px - 32))
        # Every second row and third column, since the smoothing correlates those between
        self._pixels = (
            slice(self.top_px + _MARGIN_PX, camera.height_px - _MARGIN_PX, 2),
            slice(_MARGIN_PX, camera.width_px - _MARGIN_PX, 3),
        )
        v, u = np.ogrid[self._pixels]
        self._grid = (u, v, (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px)

    def image(self, grey: NDArray[np.uint8]) -> RoadImage:
        return RoadImage(grey, self.top_px, self.config.contrast_window_px, self.config.contrast_floor_grey)

    def samples(
        self,
        tilt: tuple[float, float],
        boxes_px: Floats,
        road_mask: Bools | None,
        bend_per_m: float = 0.0,
        wide: bool = False,
    ) -> Ints:
        """Pixels (N, 2) of the current image that show road, by the mask or else in a strip ahead; without vehicles.

        The strip follows `bend_per_m`, the curvature of the car's path to the right. A `wide` strip includes the lines
        of the lane.
        """
        cam, cfg = self.camera, self.config
        normal, _, _ = plane_normal(*tilt)
        u, v, x, y = self._grid
        rho = -(normal[0] * x + (normal[1] * y + normal[2])) / cam.height_m  # Eq. 1 is X = ray / rho
        half_width_m = cfg.half_width_m if wide or road_mask is not None else cfg.lane_half_width_m
        inside = (rho > 1.0 / cfg.far_m) & (rho < 1.0 / cfg.near_m)
        middle_m = 0.0 if road_mask is not None else 0.5 * bend_per_m / np.where(inside, rho, 1.0)
        keep = (np.abs(x - middle_m) < half_width_m * rho) & inside
        if road_mask is not None:
            keep &= road_mask[self._pixels]
        x1, y1, x2, y2 = boxes_px.T
        grow_x, grow_y = 4.0 + 0.04 * (x2 - x1), 4.0 + 0.12 * (y2 - y1)  # boxes do not include the vehicle's shadow
        rows = np.searchsorted(v[:, 0], [y1 - grow_y, y2 + grow_y]).T.tolist()
        cols = np.searchsorted(u[0], [x1 - grow_x, x2 + grow_x]).T.tolist()
        for (top, bottom), (left, right) in zip(rows, cols, strict=True):
            keep[top:bottom, left:right] = False
        at = np.flatnonzero(keep.ravel())
        if len(at) > cfg.max_samples:
            at = at[(np.arange(cfg.max_samples) * (len(at) / cfg.max_samples)).astype(np.int64)]
        row, column = np.divmod(at, keep.shape[1])
        return np.column_stack([u[0, column], v[row, 0]])

    def align(
        self, past: RoadImage, present: RoadImage, T_past_present: Pose, px: Ints, prior: Floats, prior_cov: Floats,
        sigma_motion: tuple[float, float] = (0.0, 0.0), readout_share: float = 0.0,
    ) -> RoadFit | None:  # fmt: skip
        """Fits (log lambda, pitch, roll, curvature) of the current camera with a prior; None: too few samples.

        The translation of `T_past_present` times lambda is in metres. `sigma_motion` is 1-sigma of its rotation and of
        its direction (rad), at least the configured ones. `readout_share` is the readout time of an image as a fraction
        of the time between both.
        """
        cfg = self.config
        if len(px) < cfg.min_samples:
            return None
        fine = self._view(present, px, T_past_present, readout_share)
        coarse = fine.thinned(cfg.coarse_step)
        x = np.concatenate([prior, np.zeros(MOTION)])
        mean, weight_prior = x.copy(), np.zeros((ROAD + MOTION, ROAD + MOTION))
        weight_prior[:ROAD, :ROAD] = np.linalg.inv(prior_cov)
        weight_prior[ROAD:, ROAD:] = np.diag(
            np.repeat(np.maximum(sigma_motion, [cfg.sigma_rotation_rad, cfg.sigma_direction_rad]) ** -2.0, [3, 2])
        )
        brightness = None  # bias and gain of the brightness
        for view, share, tolerance, iterations in (
            (coarse, cfg.coarse_step, cfg.coarse_tolerance, cfg.max_iterations - 2),
            (fine, 1, cfg.tolerance, 3),
        ):
            for _ in range(iterations):
                places = self._places(view, T_past_present, x)
                seen, grey, by_x, by_y = self._sample_past(places, past)
                if share * int(seen.sum()) < cfg.min_samples:
                    return None
                if brightness is None:
                    brightness = _brightness(grey[seen], view.grey[seen])
                r = grey - brightness[1] * view.grey - brightness[0]
                of_past = self._gradients(view, places, by_x, by_y, T_past_present, x)
                J = of_past.derivative
                sigma = 1.4826 * upper_median(np.abs(r[seen])) + 0.5
                w = np.where(seen, 1.0 / np.maximum(1.0, np.abs(r) * (1.0 / (1.5 * sigma))), 0.0)
                w *= share * cfg.effective_sample_fraction / sigma**2
                Jw = J * w
                A, g = Jw @ J.T, Jw @ r
                A[:-2, :-2] += weight_prior
                g[:-2] += weight_prior @ (x - mean)
                A[-2, -2] += 1e-9
                A[-1, -1] += 1e-6
                step = -np.linalg.solve(A, g)
                at, gain = x, brightness[1]  # the state of `r` and `of_past`
                x = x + np.clip(step[:-2], -_MAX_STEP, _MAX_STEP)
                brightness = (brightness[0] + step[-2], brightness[1] + step[-1])
                if (np.abs(step[:-2]) < tolerance * _STEP_UNITS).all():
                    break
        of_present = self._present_gradients(fine, present, px, T_past_present, at, gain)
        motion = slice(ROAD, ROAD + MOTION)
        state, cov = fit_without_prior(at, px, of_past, of_present, r, w, weight_prior[motion, motion])
        others = [self._correlation_at(fine, past, T_past_present, at + off * _LENGTH) for off in OTHER_LENGTHS_LOG]
        samples = cfg.effective_sample_fraction * int(seen.sum())
        information = length_information(_correlation(grey, fine.grey, seen.astype(np.float64)), others, samples)
        return RoadFit(state, cov, _correlation(grey, fine.grey, w), int(seen.sum()), information)

    def _correlation_at(self, view: _View, past: RoadImage, T_past_present: Pose, x: Floats) -> float:
        """Correlation of the images at the state `x`; 0 if the past image shows none of the samples."""
        seen, grey = self._values(past, self._places(view, T_past_present, x))
        return _correlation(grey, view.grey, seen.astype(np.float64)) if seen.any() else 0.0

    def warp(self, past: RoadImage, T_past_present: Pose, px: Ints, road: Floats) -> tuple[Floats, Bools]:
        """Warps the past image to the current pixels (N, 2) by a motion and a road state (4,), without a fit.

        Returns the grey values (N,), and which of them are visible (N,).
        """
        places = self._places(self._view(past, px, T_past_present), T_past_present, np.append(road, np.zeros(MOTION)))
        seen, grey = self._values(past, places)
        return grey, seen

    def _view(self, present: RoadImage, px: Ints, T_past_present: Pose, readout_share: float = 0.0) -> _View:
        cam = self.camera
        rays = np.stack(
            [(px[:, 0] - cam.cx_px) / cam.fx_px, (px[:, 1] - cam.cy_px) / cam.fy_px, np.ones(len(px))]
        )  # fmt: skip
        grey = present.grey[px[:, 1] - present.top_px, px[:, 0]].astype(np.float64)
        turned = T_past_present.R @ rays
        if not readout_share:
            return _View(rays, turned, grey, _EMPTY, _EMPTY)
        turning = np.cross(rotation_log(T_past_present.R), turned, axis=0)
        late = readout_share * self._shutter.row(*px.T.astype(np.float64))
        return _View(rays, turned, grey, turning, late, readout_share)

    def _places(self, view: _View, T_past_present: Pose, x: Floats) -> _Places:
        """Projects the samples to the past camera, by the road and the motion of the state `x`."""
        # Eq. 1 is X = rays / rho; with the curvature rho solves H rho^2 - below rho - curvature / 2 = 0
        height_m = self.camera.height_m
        below = -(plane_normal(x[1], x[2])[0] @ view.rays)
        root = np.sqrt(np.maximum(below**2 + 2.0 * height_m * x[3], _MIN_DISCRIMINANT_RATIO * below**2))
        rho = (below + root) * (0.5 / height_m)
        shift = rho * _translation(T_past_present, x)[:, None]
        q = at_reference = rotation_exp(x[ROAD : ROAD + 3]) @ view.turned + shift
        by_z = 1.0 / np.maximum(q[2], _MIN_DEPTH_M)
        if not view.readout_share:
            return _Places(q[0] * by_z, q[1] * by_z, by_z, rho, root, 1.0)
        cam = self.camera
        for _ in range(_READOUT_ITERATIONS):
            u, v = cam.fx_px * (q[0] * by_z) + cam.cx_px, cam.fy_px * (q[1] * by_z) + cam.cy_px
            more = view.late - view.readout_share * self._shutter.row(u, v)
            q = at_reference + more * (shift + view.turning)
            by_z = 1.0 / np.maximum(q[2], _MIN_DEPTH_M)
        return _Places(q[0] * by_z, q[1] * by_z, by_z, rho, root, 1.0 + more)

    def _sample_past(self, places: _Places, past: RoadImage) -> tuple[Bools, Floats, Floats, Floats]:
        """Visibility, grey values and gradients by x and y (z = 1) of the samples in the past image."""
        cam = self.camera
        u, v, seen = self._pixels_of_past(places, past)
        grey, by_u, by_v = (
            cv2.remap(image, u, v, cv2.INTER_LINEAR).ravel().astype(np.float64)
            for image in (past.grey, *past.gradients)
        )
        return seen, grey, by_u * cam.fx_px, by_v * cam.fy_px

    def _values(self, past: RoadImage, places: _Places) -> tuple[Bools, Floats]:
        """Visibility and grey values of the samples in the past image."""
        u, v, seen = self._pixels_of_past(places, past)
        return seen, cv2.remap(past.grey, u, v, cv2.INTER_LINEAR).ravel().astype(np.float64)

    def _pixels_of_past(self, places: _Places, past: RoadImage) -> tuple[Grey, Grey, Bools]:
        """Columns, rows and visibility of the samples in the past image."""
        cam = self.camera
        u = (cam.fx_px * places.x + cam.cx_px).astype(np.float32)
        v = (cam.fy_px * places.y + (cam.cy_px - past.top_px)).astype(np.float32)
        rows, cols = past.grey.shape
        seen = (u > 1) & (u < cols - 2) & (v > 1) & (v < rows - 2) & (places.by_z < 1.0 / _MIN_VISIBLE_M)
        return u, v, seen

    def _present_gradients(
        self, view: _View, present: RoadImage, px: Ints, T_past_present: Pose, x: Floats, gain: float
    ) -> Gradients:
        """Gradients of the current image in the past camera's axes, times `gain`."""
        cam = self.camera
        places = self._places(view, T_past_present, x)
        normal, t = plane_normal(x[1], x[2])[0], _translation(T_past_present, x)
        R = rotation_exp(x[ROAD : ROAD + 3]) @ T_past_present.R
        # Derivative of the projection by the current pixel, for a flat road
        by_ray = R[:, :2] - np.outer(t, normal[:2]) / cam.height_m
        (xx, xy), (yx, yy) = (
            [(by_ray[axis, k] - place * by_ray[2, k]) * places.by_z for k in (0, 1)]
            for axis, place in ((0, places.x), (1, places.y))
        )
        by_x, by_y = (
            slope[px[:, 1] - present.top_px, px[:, 0]] * (gain * focal_px)
            for slope, focal_px in zip(present.gradients, (cam.fx_px, cam.fy_px), strict=True)
        )
        det = xx * yy - xy * yx
        det = np.where(np.abs(det) < _MIN_DETERMINANT, _MIN_DETERMINANT, det)
        return self._gradients(
            view, places, (yy * by_x - yx * by_y) / det, (xx * by_y - xy * by_x) / det, T_past_present, x
        )

    def _gradients(
        self, view: _View, places: _Places, by_x: Floats, by_y: Floats, T_past_present: Pose, x: Floats
    ) -> Gradients:
        """The residual's derivatives from image gradients by x and y at z = 1, (N,) each."""
        gx, gy = by_x * places.by_z, by_y * places.by_z
        gz = -(gx * places.x + gy * places.y)
        _, by_pitch, by_roll = plane_normal(x[1], x[2])
        t = _translation(T_past_present, x)
        rx, ry, rz = rotation_exp(x[ROAD : ROAD + 3]) @ view.turned
        along = (gx * t[0] + gy * t[1] + gz * t[2]) * places.motion
        J = np.empty((ROAD + MOTION + 2, len(gx)))
        np.multiply(along, places.rho, out=J[0])
        np.divide(along, places.root, out=along)
        np.multiply(along, 0.5, out=J[3])
        along *= -places.rho
        np.multiply(along, by_pitch @ view.rays, out=J[1])
        np.multiply(along, by_roll @ view.rays, out=J[2])
        J[4], J[5], J[6] = ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx
        by_length = places.rho * places.motion * float(np.linalg.norm(t))
        np.multiply(gx, by_length, out=J[7])
        np.multiply(gy, by_length, out=J[8])
        J[9] = -1.0
        np.negative(view.grey, out=J[10])
        return Gradients(gx, gy, J)
