"""Exports a map: its graph as g2o, its keyframes as TUM lines, its trajectories and lane lines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from birdslam.loops.map_file import MapError
from birdslam.loops.place_map import PlaceMap
from birdslam.outputs.earth_files import SUFFIXES, GeoLine, write_geo_lines
from birdslam.trajectory import ego_pose, tum_row

IN_METRES = ".map.geojson"  # in the map frame
FORMATS = ".g2o, .tum.txt, .map.geojson, .geojson, .gpx, .kml"


def export_map(place_map: PlaceMap, path: Path) -> str:
    """Writes the map; returns a description of the content. Raises MapError."""
    try:
        if path.suffix == ".g2o":
            path.write_text("".join(f"{line}\n" for line in _g2o(place_map)), encoding="ascii")
            return f"{len(place_map)} poses and {len(place_map.links)} edges"
        if path.name.endswith(".tum.txt"):
            rows = [(each.t_source_ns, ego_pose(each.T_map_keyframe, each.attitude)) for each in place_map.keyframes]
            path.write_text("".join(f"{tum_row(*row)}\n" for row in rows), encoding="ascii")
            return f"{len(place_map)} keyframes"
        if path.suffix.lower() in SUFFIXES:
            trajectories, lines = _trajectories(place_map), _lines(place_map)
            if path.name.endswith(IN_METRES):
                path.write_bytes(_in_metres([*trajectories, *lines]))
            elif place_map.earth is None:
                raise MapError(
                    f"{path}: the map is not georeferenced; drive with --map and --gnss, or export {IN_METRES}"
                )
            else:
                earth = place_map.earth
                write_geo_lines(
                    path, [replace(line, degrees=earth.wgs84(line.degrees)) for line in (*trajectories, *lines)]
                )
            return f"{len(trajectories)} trajectories and {len(lines)} lines"
    except OSError as error:
        raise MapError(f"{path}: can't be written: {error.strerror}") from None
    raise MapError(f"{path}: a map is exported as {FORMATS}")


def _g2o(place_map: PlaceMap) -> list[str]:
    out, scales = [], {each.number: each.scale for each in place_map.keyframes}
    for keyframe in place_map.keyframes:
        T = keyframe.T_map_keyframe
        out.append(f"VERTEX_SE2 {keyframe.number} {T.x_m:.9g} {T.y_m:.9g} {T.yaw_rad:.9g}")
    for link in place_map.links:
        information = np.linalg.inv(link.cov + 1e-12 * np.eye(3))[np.triu_indices(3)]
        T = link.T_from_to.scaled(scales[link.from_number])  # in metres of the map
        numbers = " ".join(f"{number:.9g}" for number in (T.x_m, T.y_m, T.yaw_rad, *information))
        out.append(f"EDGE_SE2 {link.from_number} {link.to_number} {numbers}")
    return out


def _trajectories(place_map: PlaceMap) -> list[GeoLine]:
    """Returns the trajectories of the drives, in the map frame."""
    out = []
    for drive in range(place_map.drives):
        own = [each.T_map_keyframe for each in place_map.keyframes if each.drive == drive]
        if len(own) > 1:
            about: dict[str, float | int | str] = {"drive": drive, "keyframes": len(own)}
            out.append(GeoLine(f"drive {drive}", np.array([(T.x_m, T.y_m) for T in own]), properties=about))
    return out


def _lines(place_map: PlaceMap) -> list[GeoLine]:
    """Returns the lane lines, in the map frame."""
    return [
        GeoLine(
            f"{each.kind.value} {each.line}",
            each.points_m,
            properties={
                "drive": each.drive,
                "line": each.line,
                "kind": each.kind.value,
                "colour": each.colour.value,
                "sigma_m": round(each.sigma_m, 3),
            },
        )
        for each in place_map.lines()
    ]


def _in_metres(lines: list[GeoLine]) -> bytes:
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": line.degrees.round(3).tolist()},
            "properties": {"name": line.name, **(line.properties or {})},
        }
        for line in lines
    ]
    collection = {"type": "FeatureCollection", "birdslam": {"metres_of": "the map"}, "features": features}
    return msgspec.json.encode(collection) + b"\n"
