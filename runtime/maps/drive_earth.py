"""Georeferences a drive and its map after the drive: GNSS fixes and estimates in one graph."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import link_cov
from birdslam.loops.gnss.earth import Earth, EarthError, GnssFix, align_with_fixes
from birdslam.loops.gnss.factors import Node, OnEarth, fixed_keyframes, georeference
from birdslam.loops.gnss.files import Track
from birdslam.loops.keyframe import Link, Placed
from birdslam.loops.keyframe_builder import SPACING_M
from birdslam.loops.place_map import PlaceMap
from birdslam.outputs.earth_files import SUFFIXES, GeoLine, write_geo_lines
from birdslam.outputs.placed import Place
from birdslam.runtime.maps.gnss_input import Fixes
from birdslam.types import Estimate


def places_of(estimates: list[Estimate]) -> list[Place]:
    """Returns the poses of the longest epoch; its world frame is the map frame."""
    if not estimates:
        return []
    longest = Counter(estimate.epoch for estimate in estimates).most_common(1)[0][0]
    return [
        Place(each.t_source_ns, each.epoch, each.T_world_ego, each.T_world_ego)
        for each in estimates
        if each.epoch == longest
    ]


def write_earth(
    fixes_from: Fixes | Sequence[GnssFix],
    places: Sequence[Place],
    camera: Camera,
    output: Path,
    place_map: PlaceMap | None,
) -> tuple[dict[str, Any], list[Place]]:
    """Writes ego.geojson, ego.gpx and ego.kml, and georeferences the map.

    Returns the entries of summary.json and the places. Raises GnssError, EarthError, OSError.
    """
    if not places:
        raise EarthError("the drive has no pose")
    track = fixes_from(places[0].t_source_ns) if callable(fixes_from) else Track(list(fixes_from))
    fixes = track.fixes
    t_ns, way = np.array([each.t_source_ns for each in places], np.int64), [each.T_map_ego for each in places]
    earth = align_with_fixes(t_ns, way, fixes, track.clock_is_known)
    nodes: Sequence[Placed]
    if place_map is not None and len(place_map):
        nodes, links, before = place_map.keyframes, place_map.links, place_map.fixed()
    else:
        nodes, links, before = *_nodes(way), {}
    found = georeference(earth, nodes, links, before | fixed_keyframes(earth, t_ns, way, fixes, nodes))
    bent = _bent(way, nodes, found)
    degrees = found.earth.wgs84(np.array([(pose.x_m, pose.y_m) for pose in bent]))
    about = figures(found.earth, camera)
    properties = {key: value for key, value in about.items() if isinstance(value, int | float | str)}
    line = GeoLine("ego", degrees, t_ns.tolist(), properties)
    for suffix in SUFFIXES:
        write_geo_lines(output / f"ego{suffix}", [line])
    if place_map is not None and len(place_map):
        place_map.georeference(found)
    return about, [
        replace(place, T_map_ego=pose, earth=(lat, lon, found.earth.yaw_rad + pose.yaw_rad, found.earth.scale))
        for place, pose, (lat, lon) in zip(places, bent, degrees.tolist(), strict=True)
    ]


def _nodes(way: Sequence[SE2]) -> tuple[list[Node], list[Link]]:
    """Returns the nodes of a drive without a map, one every few metres, linked by odometry."""
    nodes, links = [Node(0, way[0])], []
    for pose in way:
        step = nodes[-1].T_map_keyframe.between(pose)
        if math.hypot(step.x_m, step.y_m) >= SPACING_M:
            links.append(Link(len(nodes) - 1, len(nodes), step, link_cov(step, 0.0)))
            nodes.append(Node(len(nodes), pose))
    return nodes, links


def _bent(way: Sequence[SE2], nodes: Sequence[Placed], found: OnEarth) -> list[SE2]:
    """Moves each pose of the trajectory with its nearest keyframe."""
    before = [node.T_map_keyframe for node in nodes]
    moves = [found.poses[node.number][0] @ T.inverse() for node, T in zip(nodes, before, strict=True)]
    tree = cKDTree(np.array([(T.x_m, T.y_m) for T in before]))
    _, nearest = tree.query(np.array([(pose.x_m, pose.y_m) for pose in way]))
    return [moves[int(row)] @ pose for row, pose in zip(nearest, way, strict=True)]


def figures(earth: Earth, camera: Camera) -> dict[str, Any]:
    """Returns the entries of summary.json, which are also the properties of the files."""
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
        "hint": earth.calibration_hint(camera),
    }


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the rows of a run's summary table about GNSS."""
    fit = f"{found['fixes']} fixes, {found['outliers']} outliers, rms {found['rms_m']:.2f} m: ego.geojson, .gpx, .kml"
    out = [("GNSS", fit)]
    ratio = "" if found["speed_ratio"] is None else f", speed ratio {found['speed_ratio']:.3f}"
    sigma = 100.0 * found["sigma_scale"]
    out.append(("  scale", f"GNSS / odometry {found['scale_to_gnss']:.3f} +- {sigma:.1f} %{ratio}"))
    if found["hint"]:
        out.append(("  hint", found["hint"]))
    return out
