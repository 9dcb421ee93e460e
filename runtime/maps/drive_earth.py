"""A drive on Earth: its estimates and a file of GNSS fixes, when the drive is over."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.earth import Earth, EarthError, place_on_earth
from birdslam.loops.gnss_file import GnssError, read_fixes
from birdslam.loops.place_map import PlaceMap
from birdslam.outputs.earth_files import SUFFIXES, Way, write_ways
from birdslam.types import Estimate

Poses = list[tuple[int, SE2]]  # source time in ns, and the pose in one frame


def read_gnss(path: Path) -> bytes:
    """Raises GnssError where it can't be read; what is in it is judged with the recording's times."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise GnssError(f"{path}: can't be read: {error.strerror}") from None


def poses_of(estimates: list[Estimate]) -> Poses:
    """Those of the longest epoch: between epochs the way is unknown."""
    if not estimates:
        return []
    longest = Counter(estimate.epoch for estimate in estimates).most_common(1)[0][0]
    return [(each.t_source_ns, each.T_world_ego) for each in estimates if each.epoch == longest]


def write_earth(gnss: Path, poses: Poses, camera: Camera, output: Path, place_map: PlaceMap | None) -> dict[str, Any]:
    """Writes ego.geojson, ego.gpx and ego.kml, and places the map's keyframes; what summary.json says.

    `poses` are in the map's frame where there is a map. Raises GnssError, EarthError, OSError.
    """
    if not poses:
        raise EarthError("the drive has no pose")
    fixes = read_fixes(read_gnss(gnss), str(gnss), poses[0][0])
    earth = place_on_earth(np.array([t_ns for t_ns, _ in poses], np.int64), [pose for _, pose in poses], fixes)
    about = figures(earth, camera)
    degrees = earth.wgs84(np.array([(pose.x_m, pose.y_m) for _, pose in poses]))
    told = {key: value for key, value in about.items() if isinstance(value, int | float | str)}
    way = Way("ego", degrees, [t_ns for t_ns, _ in poses], told)
    for suffix in SUFFIXES:
        write_ways(output / f"ego{suffix}", [way])
    if place_map is not None and len(place_map):
        put_on_earth(place_map, earth)
    return about


def put_on_earth(place_map: PlaceMap, earth: Earth) -> None:
    """Every keyframe's latitude and longitude."""
    at = [keyframe.T_map_keyframe for keyframe in place_map.keyframes]
    degrees = earth.wgs84(np.array([(T.x_m, T.y_m) for T in at]))
    place_map.keyframes = [
        replace(keyframe, latitude_deg=float(lat), longitude_deg=float(lon))
        for keyframe, (lat, lon) in zip(place_map.keyframes, degrees, strict=True)
    ]


def figures(earth: Earth, camera: Camera) -> dict[str, Any]:
    """For summary.json and the properties of the files."""
    sigma_m = float(np.sqrt(np.diag(earth.cov)[:2].max()))
    return {
        "latitude_deg": round(earth.latitude_deg, 8),
        "longitude_deg": round(earth.longitude_deg, 8),
        "x_axis_from_east_rad": round(earth.yaw_rad, 6),
        "sigma_m": round(sigma_m, 3),
        "sigma_yaw_rad": round(float(np.sqrt(earth.cov[2, 2])), 6),
        "fixes": earth.fixes,
        "outliers": earth.outliers,
        "rms_m": round(earth.rms_m, 3),
        "delay_s": round(earth.delay_s, 3),
        "scale_to_gnss": round(earth.scale, 5),
        "sigma_scale": round(float(np.sqrt(earth.cov[3, 3])), 5),
        "speed_ratio": None if earth.speed_ratio is None else round(earth.speed_ratio, 4),
        "height_hint": earth.height_hint(camera.height_m),
    }


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of a run's table that speak of Earth."""
    fit = f"{found['fixes']} fixes, {found['outliers']} outliers, rms {found['rms_m']:.2f} m: ego.geojson, .gpx, .kml"
    out = [("on Earth", fit)]
    ratio = "" if found["speed_ratio"] is None else f", speed over theirs {found['speed_ratio']:.3f}"
    sigma = 100.0 * found["sigma_scale"]
    out.append(("  metres", f"GNSS over ours {found['scale_to_gnss']:.3f} +- {sigma:.1f} %{ratio}"))
    if found["height_hint"]:
        out.append(("  hint", found["height_hint"]))
    return out
