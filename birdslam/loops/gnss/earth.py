"""Where a drive is on Earth: its frame tied to WGS 84 by GNSS fixes, with a gate against wrong ones.

Fixes are joined to the drive's own way by their time. One similarity of the plane (turn, shift and scale, since metres
are odometry's) is adjusted to all of them with Cauchy weights, together with the fixes' delay. What a wrong fix says is
out of the gate; jumps and multipath of some seconds do not turn a way that odometry holds together.
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

MIN_FIXES, MIN_WAY_M = 3, 20.0
GATE = 3.0  # standard deviations
DELAYS_S = np.arange(-2.0, 2.01, 0.1)
DELAY_SIGMA_S = 0.5
WINDOW_S, MAX_WINDOWS = 60.0, 10  # in which fixes are compared with odometry for their delay
OFFSET_STEP_S, MAX_OFFSETS = 1.0, 3600  # of the parts of a longer track that are compared with a drive
SURE_COST = math.log(1000.0)  # by which the best part has to be better than every other
START_FIXES = 60  # whose pairs are tried for a start
START_REL = 0.1  # drift of odometry over the distance from the centre, up to which a fix agrees with a start
ITERATIONS, WINDOW_ITERATIONS = 30, 16
SCALE_SIGMA = 0.1  # of the scale's logarithm, by the camera's file
SPEED_SIGMA = 0.01  # of all speeds of a drive together, which receivers smooth
DEFAULT_SIGMA_M = 5.0  # of a fix that does not say its own
HINT_SIGMAS, HINT_REL = 3.0, 0.02  # a wrong height, or view, is reported where it is that sure, and that large


class GnssFix(msgspec.Struct, frozen=True, kw_only=True):
    """One fix, by the recording's clock."""

    t_source_ns: int
    latitude_deg: float
    longitude_deg: float
    sigma_m: float = DEFAULT_SIGMA_M  # 1-sigma, across the ground
    speed_mps: float | None = None


def is_on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Whether there is such a place; NaN is none."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0


class EarthError(ValueError):
    """The fixes do not determine the pose of the drive on Earth."""


@dataclass(frozen=True, eq=False)
class Earth:
    """East and north in metres from the origin: `scale` R(`yaw_rad`) p + (`east_m`, `north_m`)."""

    latitude_deg: float  # of the origin
    longitude_deg: float
    east_m: float
    north_m: float
    yaw_rad: float  # of the map's x axis from east, counter-clockwise
    scale: float  # of Earth's metres over the map's
    cov: Floats  # (4, 4) of east_m, north_m, yaw_rad, log scale
    delay_s: float  # by which the fixes' times lie behind the images'
    fixes: int
    outliers: int
    rms_m: float  # of the inliers
    speed_ratio: float | None  # of the drive's speed over the fixes' own, the median; None: they have none
    late_m: float = 0.0  # 1-sigma by which the delay, as far as it is not known, puts all places off
    log_scale: tuple[float, float] = (0.0, SCALE_SIGMA)  # of what is known beside the places, with its 1-sigma

    def with_cov(self, cov: Floats) -> Earth:
        """`cov` (4, 4) is that of the fixes alone."""
        return replace(self, cov=cov + np.diag([self.late_m**2, self.late_m**2, 0.0, 0.0]))

    def enu(self, xy_m: Floats) -> Floats:
        """(N, 2) east and north of points of the map (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return self.scale * (xy_m @ np.array([[c, s], [-s, c]])) + (self.east_m, self.north_m)

    def wgs84(self, xy_m: Floats) -> Floats:
        """(N, 2) latitude and longitude in degrees of points of the map (N, 2)."""
        import pymap3d  # here: only who goes to Earth needs it

        enu = self.enu(np.asarray(xy_m, np.float64).reshape(-1, 2))
        zero = np.zeros(len(enu))
        lat, lon, _ = pymap3d.enu2geodetic(enu[:, 0], enu[:, 1], zero, self.latitude_deg, self.longitude_deg, 0.0)
        return np.column_stack([np.atleast_1d(lat), np.atleast_1d(lon)])

    def xy(self, degrees: Floats) -> Floats:
        """(N, 2) in the map of latitudes and longitudes in degrees (N, 2)."""
        import pymap3d  # here: only who comes from Earth needs it

        east, north, _ = pymap3d.geodetic2enu(
            degrees[:, 0], degrees[:, 1], 0.0, self.latitude_deg, self.longitude_deg, 0.0
        )
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        enu = np.column_stack([east, north]) - (self.east_m, self.north_m)
        out: Floats = enu @ np.array([[c, -s], [s, c]]) / self.scale
        return out

    def seen_from(self, T_other_map: SE2) -> Earth:
        """The same place in another map's frame."""
        T = T_other_map.inverse()
        east, north = (float(number) for number in self.enu(np.array([[T.x_m, T.y_m]]))[0])
        return replace(self, east_m=east, north_m=north, yaw_rad=wrap(self.yaw_rad + T.yaw_rad))

    def pose(self, T_map_ego: SE2, cov: Floats) -> EarthPose:
        """An ego of the map on Earth; `cov` (3, 3), of the tangent there: its own, and that of the map around it."""
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
        """What the metres of the fixes say of the camera's file; "" where they say nothing against it.

        Our metres are in proportion to the height, and about to the focal length: a straight way can't tell which.
        """
        sigma = math.sqrt(self.cov[3, 3])
        if abs(math.log(self.scale)) < max(HINT_SIGMAS * sigma, HINT_REL):
            return ""
        height_m = camera.height_m
        now_deg, fits_deg = (_view_deg(camera, scale) for scale in (1.0, self.scale))
        return (
            f"camera height {height_m * self.scale:.2f} m instead of {height_m:.2f} m fits GNSS "
            f"(within {height_m * self.scale * 2.0 * sigma:.2f} m); or, if the height was measured, a view of "
            f"{fits_deg:.0f} degrees across instead of {now_deg:.0f}"
        )


def _view_deg(camera: Camera, scale: float) -> float:
    """By a multiple of the camera's focal length, without distortion."""
    half = 0.5 * camera.width_px / (scale * camera.fx_px)
    return 2.0 * math.degrees(half if camera.fisheye else math.atan(half))


def place_on_earth(t_ns: Ints, poses: list[SE2], fixes: list[GnssFix], clock_is_known: bool = True) -> Earth:
    """Returns the map's frame on Earth, by a drive's poses in it (times growing) and its fixes. Raises EarthError.

    Where the fixes have another clock, the part of their track that has the shape of the drive is found first.
    """
    import pymap3d  # here: only who goes to Earth needs it

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
        raise EarthError(f"{len(fixes)} fixes, and fewer than {MIN_FIXES} of them within the drive's time")
    here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
    ratios = _speed_ratios(seconds, xy, times - delay_s, fixes)
    log_scale = _log_scale(ratios)
    parameters, cov, chi2 = fit(here, enu[inside], sigma[inside], log_scale=log_scale)
    way_m = float(np.linalg.norm(np.ptp(here, axis=0)))
    if way_m < MIN_WAY_M:
        raise EarthError(f"the drive goes {way_m:.0f} m between its fixes: {MIN_WAY_M:g} m are needed for a heading")
    good = chi2 < GATE**2
    if good.sum() < MIN_FIXES:
        raise EarthError(f"only {int(good.sum())} of {len(chi2)} fixes fit the drive's way")
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
    """By how much fixes come late, and its 1-sigma: what fits best over short windows, before odometry drifts far.

    Curves and changes of speed tell delays apart; where there are none the prior keeps them at 0.
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
                cost += float(np.log1p(chi2).sum())
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
    """(east, north, yaw, log scale), their covariance, and each fix's chi-square; Gauss-Newton with Cauchy weights.

    `log_scale`: what is known of it beforehand, with its 1-sigma.
    The start is the pair of fixes that most others agree with (RANSAC over all pairs of evenly spaced fixes).
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
    """Yaw and shift (2,) of `enu` over `a` (N, 2) by the pair of points with the least sum of truncated errors."""
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
    """The fix (latitude, longitude) that is nearest to the median of all: a single one may be anywhere."""
    nearest = int(np.abs(degrees - np.median(degrees, axis=0)).sum(axis=1).argmin())
    return float(degrees[nearest, 0]), float(degrees[nearest, 1])


def _speed_ratios(seconds: Floats, xy: Floats, at: Floats, fixes: list[GnssFix]) -> list[float]:
    """Of ours over theirs, in each second around a fix that tells its speed."""
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
    """What the fixes' speeds, by their median, and the camera's file tell of the scale."""
    by_file = SCALE_SIGMA**-2
    if len(ratios) < MIN_FIXES:
        return 0.0, SCALE_SIGMA
    logs = -np.log(ratios)
    middle = float(np.median(logs))
    sigma = 1.4826 * float(np.median(np.abs(logs - middle))) * math.sqrt(0.5 * math.pi / len(logs))  # of a median
    by_speed = max(sigma, SPEED_SIGMA) ** -2
    return middle * by_speed / (by_speed + by_file), (by_speed + by_file) ** -0.5
