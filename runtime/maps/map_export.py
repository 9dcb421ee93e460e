"""A map in the formats of others: its graph as g2o, its keyframes as TUM lines, its ways on Earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from birdslam.loops.map_file import MapError
from birdslam.loops.place_map import PlaceMap
from birdslam.outputs.earth_files import SUFFIXES, Way, write_ways
from birdslam.trajectory import ego_pose, tum_row

FORMATS = ".g2o, .tum.txt, .geojson, .gpx, .kml"


def export_map(place_map: PlaceMap, path: Path) -> str:
    """Writes it; says what. Raises MapError."""
    try:
        if path.suffix == ".g2o":
            path.write_text("".join(f"{line}\n" for line in _g2o(place_map)), encoding="ascii")
            return f"{len(place_map)} poses and {len(place_map.links)} edges"
        if path.name.endswith(".tum.txt"):
            rows = [(each.t_source_ns, ego_pose(each.T_map_keyframe, each.attitude)) for each in place_map.keyframes]
            path.write_text("".join(f"{tum_row(*row)}\n" for row in rows), encoding="ascii")
            return f"{len(place_map)} keyframes"
        if path.suffix.lower() in SUFFIXES:
            ways = [
                way for drive in range(place_map.drives) for way in [_way(place_map, drive)] if len(way.degrees) > 1
            ]
            if not ways:
                raise MapError(f"{path}: the map is not on Earth yet: drive with --map and --gnss")
            write_ways(path, ways)
            return f"{len(ways)} ways"
    except OSError as error:
        raise MapError(f"{path}: can't be written: {error.strerror}") from None
    raise MapError(f"{path}: a map is exported as {FORMATS}")


def _g2o(place_map: PlaceMap) -> list[str]:
    out = []
    for keyframe in place_map.keyframes:
        T = keyframe.T_map_keyframe
        out.append(f"VERTEX_SE2 {keyframe.number} {T.x_m:.9g} {T.y_m:.9g} {T.yaw_rad:.9g}")
    for link in place_map.links:
        information = np.linalg.inv(link.cov + 1e-12 * np.eye(3))[np.triu_indices(3)]
        T = link.T_from_to
        numbers = " ".join(f"{number:.9g}" for number in (T.x_m, T.y_m, T.yaw_rad, *information))
        out.append(f"EDGE_SE2 {link.from_number} {link.to_number} {numbers}")
    return out


def _way(place_map: PlaceMap, drive: int) -> Way:
    own = [each.T_map_keyframe for each in place_map.keyframes if each.drive == drive and place_map.earth is not None]
    xy = np.array([(T.x_m, T.y_m) for T in own]).reshape(-1, 2)
    degrees = xy if place_map.earth is None else place_map.earth.wgs84(xy)
    return Way(f"drive {drive}", degrees, about={"drive": drive, "keyframes": len(own)})
