"""Aligns the frame of a drive with WGS 84 by GNSS fixes, robust to outliers.

Fixes are assigned to the trajectory by their time. A similarity of the plane (rotation, translation, scale) is fitted
to all of them with Cauchy weights, together with the fixes' delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2, wrap
from birdslam.loops.map_pose import EarthPose
from birdslam.types import NS_PER_S

MIN_FIXES, MIN_EXTENT_M = 3, 20.0
GATE = 3.0  # standard deviations
DELAYS_S = np.arange(-2.0, 2.01, 0.1)
DELAY_SIGMA_S = 0.5
WINDOW_S, MAX_WINDOWS = 60.0, 10  # for the estimate of the delay
OFFSET_STEP_S, MAX_OFFSETS = 1.0, 3600  # for the search of a drive within a longer track
SURE_COST = math.log(1000.0)  # min. difference of costs between the best part and all others
START_FIXES = 60  # whose pairs give initial values
START_REL = 0.1  # max. drift of an inlier relative to its distance from the centre
ITERATIONS, WINDOW_ITERATIONS = 30, 16
SCALE_SIGMA = 0.1  # prior of the log scale, by the camera file
SPEED_SIGMA = 0.01  # common relative error of the receiver's speeds
DEFAULT_SIGMA_M = 5.0  # of a fix without an accuracy
HINT_SIGMAS, HINT_REL = 3.0, 0.02  # min. significance and size of a reported scale error


class GnssFix(msgspec.Struct, frozen=True, kw_only=True):
    """One fix, on the recording's clock."""

    t_source_ns: int
    latitude_deg: float
    longitude_deg: float
    sigma_m: float = DEFAULT_SIGMA_M  # horizontal 1-sigma
    speed_mps: float | None = None


def is_on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Whether latitude and longitude are valid; NaN is not."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0


class EarthError(ValueError):
    """The fixes do not determine the pose of the drive on Earth."""


@dataclass(frozen=True, eq=False)
class Earth:
    """The georeference of a map: east and north from the origin are `scale` R(`yaw_rad`) p + (`east_m`, `north_m`)."""

    latitude_deg: float  # of the origin
    longitude_deg: float
    east_m: float
    north_m: float
    yaw_rad: float  # of the map's x axis from east, counter-clockwise
    scale: float  # metres on Earth over map metres
    cov: Floats  # (4, 4) of east_m, north_m, yaw_rad, log scale
    delay_s: float  # of the fixes relative to the images
    fixes: int
    outliers: int
    rms_m: float  # of the inliers
    speed_ratio: float | None  # median of the drive's speed over the fixes' speed; None: they have none
    late_m: float = 0.0  # 1-sigma of all positions from the uncertainty of the delay
    log_scale: tuple[float, float] = (0.0, SCALE_SIGMA)  # prior of the log scale with its 1-sigma

    def with_cov(self, cov: Floats) -> Earth:
        """Sets the covariance; `cov` (4, 4) is that of the fixes, without the delay."""
        return replace(self, cov=cov + np.diag([self.late_m**2, self.late_m**2, 0.0, 0.0]))

    def enu(self, xy_m: Floats) -> Floats:
        """Converts map points (N, 2) to east and north (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return self.scale * (xy_m @ np.array([[c, s], [-s, c]])) + (self.east_m, self.north_m)

    def wgs84(self, xy_m: Floats) -> Floats:
        """Converts map points (N, 2) to latitude and longitude in degrees (N, 2)."""
        import pymap3d

        enu = self.enu(np.asarray(xy_m, np.float64).reshape(-1, 2))
        zero = np.zeros(len(enu))
        lat, lon, _ = pymap3d.enu2geodetic(enu[:, 0], enu[:, 1], zero, self.latitude_deg, self.longitude_deg, 0.0)
        return np.column_stack([np.atleast_1d(lat), np.atleast_1d(lon)])

    def xy(self, degrees: Floats) -> Floats:
        """Converts latitudes and longitudes in degrees (N, 2) to map points (N, 2)."""
        import pymap3d

        east, north, _ = pymap3d.geodetic2enu(
            degrees[:, 0], degrees[:, 1], 0.0, self.latitude_deg, self.longitude_deg, 0.0
        )
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        enu = np.column_stack([east, north]) - (self.east_m, self.north_m)
        out: Floats = enu @ np.array([[c, -s], [s, c]]) / self.scale
        return out

    def seen_from(self, T_other_map: SE2) -> Earth:
        """Returns the georeference of another map's frame."""
        T = T_other_map.inverse()
        east, north = (float(number) for number in self.enu(np.array([[T.x_m, T.y_m]]))[0])
        return replace(self, east_m=east, north_m=north, yaw_rad=wrap(self.yaw_rad + T.yaw_rad))

    def pose(self, T_map_ego: SE2, cov: Floats) -> EarthPose:
        """Converts a pose in the map to Earth; `cov` (3, 3): of the tangent, including the map's covariance there."""
        p = np.array([T_map_ego.x_m, T_map_ego.y_m])
        latitude_deg, longitude_deg = (float(number) for number in self.wgs84(p[None])[0])
        yaw_rad = wrap(self.yaw_rad + T_map_ego.yaw_rad)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        lever = self.scale * np.array([[c, -s], [s, c]]) @ p
        J = np.array([[1.0, 0.0, -lever[1], lever[0]], [0.0, 1.0, lever[0], lever[1]]])
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        R = self.scale * np.array([[c, -s], [s, c]])
        place = J @ self.cov @ J.T + R @ cov[:2, :2] @ R.T
        return EarthPose(
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            cov=tuple(float(number) for number in place.ravel()),
            yaw_rad=yaw_rad,
            yaw_sigma_rad=math.sqrt(self.cov[2, 2] + cov[2, 2]),
        )

    def calibration_hint(self, camera: Camera) -> str:
        """Returns a correction of the camera file by the fixes' scale; "" if none is significant.

        Lengths are proportional to the height, and about to the focal length: a straight road does not separate them.
        """
        sigma = math.sqrt(self.cov[3, 3])
        if abs(math.log(self.scale)) < max(HINT_SIGMAS * sigma, HINT_REL):
            return ""
        height_m = camera.height_m
        now_deg, fits_deg = (_view_deg(camera, scale) for scale in (1.0, self.scale))
        return (
            f"a camera height of {height_m * self.scale:.2f} m instead of {height_m:.2f} m fits GNSS "
            f"(+- {height_m * self.scale * 2.0 * sigma:.2f} m); or, if the height was measured, a field of view of "
            f"{fits_deg:.0f} degrees instead of {now_deg:.0f}"
        )


def _view_deg(camera: Camera, scale: float) -> float:
    """Returns the horizontal field of view for a multiple of the focal length, without distortion."""
    half = 0.5 * camera.width_px / (scale * camera.fx_px)
    return 2.0 * math.degrees(half if camera.fisheye else math.atan(half))


def align_with_fixes(t_ns: Ints, poses: list[SE2], fixes: list[GnssFix], clock_is_known: bool = True) -> Earth:
    """Aligns a drive's poses, with increasing times, with its fixes. Raises EarthError.

    If the fixes have an unrelated clock, the part of their track with the shape of the drive is searched first.
    """
    import pymap3d

    if not fixes or len(poses) < 2:
        raise EarthError("there are no fixes within the drive")
    xy = np.array([(pose.x_m, pose.y_m) for pose in poses])
    seconds = (t_ns - t_ns[0]) / NS_PER_S
    times = np.array([(fix.t_source_ns - int(t_ns[0])) / NS_PER_S for fix in fixes])
    degrees = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    origin = _central(degrees)
    east, north, _ = pymap3d.geodetic2enu(degrees[:, 0], degrees[:, 1], 0.0, *origin, 0.0)
    enu, sigma = np.column_stack([east, north]), np.array([max(fix.sigma_m, 0.01) for fix in fixes])
    offset_s = 0.0 if clock_is_known else _offset_s(seconds, xy, times, enu, sigma)
    delay_s, delay_sigma_s = _delay(seconds, xy, times - offset_s, enu, sigma)
    delay_s += offset_s
    late_m = delay_sigma_s * float(np.hypot(*np.diff(xy, axis=0).T).sum() / seconds[-1])
    at = times - delay_s
    inside = (at >= seconds[0]) & (at <= seconds[-1])
    if inside.sum() < MIN_FIXES:
        raise EarthError(f"fewer than {MIN_FIXES} of {len(fixes)} fixes are within the drive's time")
    here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
    ratios = _speed_ratios(seconds, xy, times - delay_s, fixes)
    log_scale = _log_scale(ratios)
    parameters, cov, chi2 = fit(here, enu[inside], sigma[inside], log_scale=log_scale)
    way_m = float(np.linalg.norm(np.ptp(here, axis=0)))
    if way_m < MIN_EXTENT_M:
        raise EarthError(f"the fixes extend over {way_m:.0f} m: {MIN_EXTENT_M:g} m are needed for a heading")
    good = chi2 < GATE**2
    if good.sum() < MIN_FIXES:
        raise EarthError(f"only {int(good.sum())} of {len(chi2)} fixes fit the trajectory")
    error_m = np.sqrt(chi2[good]) * sigma[inside][good]
    return Earth(
        *origin,
        float(parameters[0]),
        float(parameters[1]),
        float(parameters[2]),
        float(math.exp(parameters[3])),
        cov,
        delay_s,
        int(inside.sum()),
        int((~good).sum()),
        float(np.sqrt((error_m**2).mean())),
        float(np.median(ratios)) if ratios else None,
        late_m,
        log_scale,
    ).with_cov(cov)


def _offset_s(seconds: Floats, xy: Floats, times: Floats, enu: Floats, sigma: Floats) -> float:
    """Returns by how much later than the first fix the drive begins, where the fixes' clock is another one.

    The similarity fit of every part of the track that is as long as the drive is compared by its costs (robust, as in
    `_delay`, with the prior of the scale). Raises EarthError where two parts fit alike.
    """
    longest_s = float(times[-1] - times[0] - seconds[-1])
    if longest_s <= OFFSET_STEP_S:
        return 0.0
    offsets = np.arange(0.0, longest_s + OFFSET_STEP_S, max(OFFSET_STEP_S, longest_s / MAX_OFFSETS))
    costs = np.full(len(offsets), np.inf)
    for k, offset_s in enumerate(offsets):
        at = times - offset_s
        inside = (at >= seconds[0]) & (at <= seconds[-1])
        if inside.sum() > MIN_FIXES:
            here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
            found, _, chi2 = fit(here, enu[inside], sigma[inside], WINDOW_ITERATIONS)
            costs[k] = float(np.log1p(chi2).sum()) + 0.5 * (found[3] / SCALE_SIGMA) ** 2
    best = int(costs.argmin())
    others = costs[np.abs(offsets - offsets[best]) > 2.0 * DELAYS_S[-1]]
    if not np.isfinite(costs[best]) or (len(others) and others.min() < costs[best] + SURE_COST):
        raise EarthError(
            f"the track of fixes lasts {times[-1] - times[0]:.0f} s and the drive {seconds[-1]:.0f} s by unrelated "
            "clocks, and several parts of the track have the drive's shape; state the time from the first fix to the "
            "first frame (--gnss-offset S)"
        )
    return float(offsets[best])


def _delay(seconds: Floats, xy: Floats, times: Floats, enu: Floats, sigma: Floats) -> tuple[float, float]:
    """Estimates the delay of the fixes and its 1-sigma, over short windows with little drift.

    The delay is observable in curves and at changes of speed; else the prior keeps it at 0.
    """
    begin, windows = 0, []
    for end in range(1, len(times) + 1):
        if end == len(times) or times[end] - times[begin] > WINDOW_S:
            if end - begin > MIN_FIXES:
                windows.append(slice(begin, end))
            begin = end
    windows = windows[:: max(1, -(-len(windows) // MAX_WINDOWS))]
    costs = []
    for delay_s in DELAYS_S:
        cost = 0.5 * (delay_s / DELAY_SIGMA_S) ** 2
        for window in windows:
            at = times[window] - delay_s
            inside = (at >= seconds[0]) & (at <= seconds[-1])
            cost += float((~inside).sum()) * math.log1p(GATE**2)
            if inside.sum() > MIN_FIXES:
                here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
                chi2 = fit(here, enu[window][inside], sigma[window][inside], WINDOW_ITERATIONS)[2]
                cost += float(np.log1p(np.minimum(chi2, GATE**2)).sum())  # at most that of a fix outside the drive
        costs.append(cost)
    weight = np.exp(min(costs) - np.array(costs))
    mean_s = round(float(weight @ DELAYS_S / weight.sum()), 3)
    return mean_s, math.sqrt(float(weight @ (DELAYS_S - mean_s) ** 2 / weight.sum()))


def fit(
    xy: Floats,
    enu: Floats,
    sigma: Floats,
    iterations: int = ITERATIONS,
    log_scale: tuple[float, float] = (0.0, SCALE_SIGMA),
) -> tuple[Floats, Floats, Floats]:
    """Returns (east, north, yaw, log scale), their covariance, and each fix's chi-square.

    Gauss-Newton with Cauchy weights, initialized by RANSAC over pairs of evenly spaced fixes. `log_scale`: prior with
    its 1-sigma.
    """
    centre = np.median(xy, axis=0)
    a = xy - centre
    known, by = log_scale[0], log_scale[1] ** -2
    yaw, shift = _start(a, enu, sigma, math.exp(known))
    log_scale_now = known
    H: Floats = np.eye(4)
    chi2: Floats = np.zeros(len(xy))
    for iteration in range(iterations):
        c, s, scale = math.cos(yaw), math.sin(yaw), math.exp(log_scale_now)
        rotated = a @ np.array([[c, s], [-s, c]]) * scale
        error = enu - rotated - shift
        chi2 = (error**2).sum(axis=1) / sigma**2
        weight = 1.0 / (1.0 + chi2 / (9.0 if iteration < iterations // 2 else 2.0)) / sigma**2
        J = np.zeros((len(xy), 2, 4))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2], J[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
        J[:, :, 3] = rotated
        H = np.einsum("nai,n,naj->ij", J, weight, J)
        H[3, 3] += by
        g = np.einsum("nai,n,na->i", J, weight, error)
        g[3] -= (log_scale_now - known) * by
        step = np.linalg.solve(H + 1e-9 * np.eye(4), g)
        shift, yaw = shift + step[:2], yaw + float(np.clip(step[2], -0.5, 0.5))
        log_scale_now = float(np.clip(log_scale_now + step[3], -0.7, 0.7))
    c, s, scale = math.cos(yaw), math.sin(yaw), math.exp(log_scale_now)
    moved = shift - scale * (centre @ np.array([[c, s], [-s, c]]))
    cov: Floats = np.linalg.inv(H + 1e-9 * np.eye(4)).astype(np.float64)
    return np.array([*moved, yaw, log_scale_now]), cov, chi2


def _start(a: Floats, enu: Floats, sigma: Floats, scale: float) -> tuple[float, Floats]:
    """Returns the yaw and translation (2,) from `a` (N, 2) to `enu` with the least sum of truncated errors."""
    p, q = scale * (a[:, 0] + 1j * a[:, 1]), enu[:, 0] + 1j * enu[:, 1]
    some = np.unique(np.linspace(0, len(p) - 1, START_FIXES).astype(int))
    i, j = (some[k] for k in np.triu_indices(len(some), 1))
    far = np.abs(p[j] - p[i]) >= 0.25 * np.abs(p - p.mean()).max()
    i, j = i[far], j[far]
    if not len(i):
        return 0.0, np.median(enu, axis=0)
    turn = np.exp(1j * np.angle((q[j] - q[i]) / np.where(p[j] == p[i], 1.0, p[j] - p[i])))
    shift = 0.5 * (q[i] + q[j] - turn * (p[i] + p[j]))
    error = np.abs(q - turn[:, None] * p - shift[:, None]) / np.maximum(3.0 * sigma, START_REL * np.abs(p))
    best = int(np.minimum(error, 1.0).sum(axis=1).argmin())
    return float(np.angle(turn[best])), np.array([shift[best].real, shift[best].imag])


def _central(degrees: Floats) -> tuple[float, float]:
    """Returns the fix (latitude, longitude) nearest to the median, since a single fix may be an outlier."""
    nearest = int(np.abs(degrees - np.median(degrees, axis=0)).sum(axis=1).argmin())
    return float(degrees[nearest, 0]), float(degrees[nearest, 1])


def _speed_ratios(seconds: Floats, xy: Floats, at: Floats, fixes: list[GnssFix]) -> list[float]:
    """Returns the ratio of the drive's speed to each fix's speed, over one second."""
    ratios = []
    for t, fix in zip(at, fixes, strict=True):
        if fix.speed_mps is None or fix.speed_mps < 3.0 or t - 0.5 < seconds[0] or t + 0.5 > seconds[-1]:
            continue
        inside = (seconds >= t - 0.5) & (seconds <= t + 0.5)
        if inside.sum() > 1:
            way = np.hypot(*np.diff(xy[inside], axis=0).T).sum()
            ratios.append(float(way / (seconds[inside][-1] - seconds[inside][0]) / fix.speed_mps))
    return ratios


def _log_scale(ratios: list[float]) -> tuple[float, float]:
    """Returns the prior of the log scale from the fixes' speeds and the camera file."""
    by_file = SCALE_SIGMA**-2
    if len(ratios) < MIN_FIXES:
        return 0.0, SCALE_SIGMA
    logs = -np.log(ratios)
    middle = float(np.median(logs))
    sigma = 1.4826 * float(np.median(np.abs(logs - middle))) * math.sqrt(0.5 * math.pi / len(logs))  # of a median
    by_speed = max(sigma, SPEED_SIGMA) ** -2
    return middle * by_speed / (by_speed + by_file), (by_speed + by_file) ** -0.5
