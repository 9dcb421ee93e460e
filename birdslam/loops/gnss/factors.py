"""GNSS fixes as factors of a map's graph, which removes drift and georeferences the map.

1. `align_with_fixes` aligns odometry's trajectory with the fixes: delay, rotation, translation, scale.
2. Each keyframe gets its nearest fix, moved along the trajectory. Graduated non-convexity rejects outliers.
3. The graph of keyframes, links and fixes is solved in map metres, east and north; the scale is updated, and the graph
   solved again. The first keyframe keeps its pose in the map, and `Earth` is fitted to the keyframes' fixes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Ints
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import PlaceFactor, Solved, close_loops, inliers
from birdslam.loops.gnss.earth import MIN_FIXES, Earth, EarthError, GnssFix, fit
from birdslam.loops.keyframe import Fixed, Link, Placed
from birdslam.types import NS_PER_S

REACH_M = 6.0  # max. distance of a fix from its keyframe
SHARED_S = 10.0  # fixes within this time have a common error; by judgement
ROUNDS = 2  # of the scale


@dataclass(frozen=True)
class Node:
    """A node of a drive without a map: a keyframe without points."""

    number: int
    T_map_keyframe: SE2
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class OnEarth:
    """A georeferenced graph."""

    earth: Earth
    poses: dict[int, Solved]  # of each keyframe in the map
    fixed: dict[int, Fixed]  # inlier fixes by keyframe


def fixed_keyframes(
    earth: Earth, t_ns: Ints, poses: Sequence[SE2], fixes: Sequence[GnssFix], keyframes: Sequence[Placed]
) -> dict[int, Fixed]:
    """Assigns to each keyframe its nearest fix, given the drive's alignment `earth`."""
    from scipy.spatial import cKDTree

    xy = np.array([(pose.x_m, pose.y_m) for pose in poses])
    seconds = (t_ns - t_ns[0]) / NS_PER_S
    at = np.array([(fix.t_source_ns - int(t_ns[0])) / NS_PER_S for fix in fixes]) - earth.delay_s
    inside = np.flatnonzero((at >= seconds[0]) & (at <= seconds[-1]))
    here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
    degrees = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])[inside]
    places = np.array([(k.T_map_keyframe.x_m, k.T_map_keyframe.y_m) for k in keyframes])
    nearest: dict[int, tuple[float, int]] = {}
    for row, (distance, place) in enumerate(zip(*cKDTree(places).query(here.reshape(-1, 2)), strict=True)):
        if distance < min(REACH_M, nearest.get(int(place), (math.inf, 0))[0]):
            nearest[int(place)] = float(distance), row
    out = {}
    times = np.array([at[inside][row] for _, row in nearest.values()])
    for place, (_, row) in nearest.items():
        together = int((np.abs(times - at[inside][row]) <= SHARED_S / 2.0).sum())
        there = earth.xy(degrees[row : row + 1])[0] + places[place] - here[row]
        latitude_deg, longitude_deg = earth.wgs84(there[None])[0]
        sigma_m = max(fixes[inside[row]].sigma_m, 0.01)
        out[keyframes[place].number] = Fixed(
            float(latitude_deg), float(longitude_deg), sigma_m, sigma_m * math.sqrt(together)
        )
    return out


def georeference(earth: Earth, keyframes: Sequence[Placed], links: Sequence[Link], fixed: dict[int, Fixed]) -> OnEarth:
    """Solves the graph with its fixes. Raises EarthError with too few inliers."""
    first, numbers = keyframes[0], list(fixed)
    degrees = np.array([(fixed[number].latitude_deg, fixed[number].longitude_deg) for number in numbers])
    kept = np.ones(len(numbers), bool)
    for turn in range(ROUNDS):
        T_earth_map = SE2(earth.east_m / earth.scale, earth.north_m / earth.scale, earth.yaw_rad)
        flat = replace(earth, east_m=0.0, north_m=0.0, yaw_rad=0.0)  # east and north in metres of the map
        nodes = [Node(each.number, T_earth_map @ each.T_map_keyframe, each.scale) for each in keyframes]
        factors = [
            PlaceFactor(
                number, (float(x), float(y)), fixed[number].sigma_m / earth.scale, fixed[number].weighed_m / earth.scale
            )
            for number, (x, y) in zip(numbers, flat.xy(degrees), strict=True)
        ]
        kept = inliers(nodes, links, factors)
        if kept.sum() < MIN_FIXES:
            raise EarthError(f"only {int(kept.sum())} of {len(kept)} fixes fit the trajectory")
        solved = close_loops(nodes, links, [factor for factor, fits in zip(factors, kept, strict=True) if fits])
        T_map_earth = first.T_map_keyframe @ solved[first.number][0].inverse()
        poses = {number: each._replace(T_map_keyframe=T_map_earth @ each[0]) for number, each in solved.items()}
        earth = _fitted(earth, poses, fixed, [number for number, fits in zip(numbers, kept, strict=True) if fits])
        if turn < ROUNDS - 1:
            earth = replace(earth, scale=earth.scale * _stretch(links, poses))
    fitting = {number: fixed[number] for number, fits in zip(numbers, kept, strict=True) if fits}
    return OnEarth(replace(earth, outliers=int((~kept).sum()), fixes=len(kept)), poses, fitting)


def _stretch(links: Sequence[Link], poses: dict[int, Solved]) -> float:
    """Returns the ratio by which the fixes lengthened odometry's links."""
    asked = total = 0.0
    for link in links:
        if not link.loop:
            step, found = link.T_from_to, poses[link.from_number][0].between(poses[link.to_number][0])
            asked += step.x_m**2 + step.y_m**2
            total += step.x_m * found.x_m + step.y_m * found.y_m
    return total / asked if asked else 1.0


def _fitted(earth: Earth, poses: dict[int, Solved], fixed: dict[int, Fixed], numbers: list[int]) -> Earth:
    """Fits the georeference to the current keyframes and the inlier fixes."""
    flat = replace(earth, east_m=0.0, north_m=0.0, yaw_rad=0.0, scale=1.0)
    degrees = np.array([(fixed[number].latitude_deg, fixed[number].longitude_deg) for number in numbers])
    xy = np.array([(poses[number][0].x_m, poses[number][0].y_m) for number in numbers])
    enu = flat.xy(degrees)
    sigma_m = np.array([fixed[number].weighed_m for number in numbers])
    parameters, cov, _ = fit(xy, enu, sigma_m, log_scale=earth.log_scale)
    found = replace(
        earth,
        east_m=float(parameters[0]),
        north_m=float(parameters[1]),
        yaw_rad=float(parameters[2]),
        scale=float(math.exp(parameters[3])),
    ).with_cov(cov)
    return replace(found, rms_m=float(np.sqrt(((found.enu(xy) - enu) ** 2).sum(axis=1).mean())))
