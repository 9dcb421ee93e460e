"""Writes lines on Earth as GeoJSON (RFC 7946), GPX 1.1 and KML 2.2, in WGS 84 degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import msgspec

from birdslam.geometry.arrays import Floats
from birdslam.types import NS_PER_S

SUFFIXES = ".geojson", ".gpx", ".kml"


@dataclass(frozen=True, eq=False)
class GeoLine:
    """A line on Earth: latitude and longitude (N, 2) in degrees, with the times of the recording if known."""

    name: str
    degrees: Floats
    t_ns: Sequence[int] = ()
    properties: dict[str, float | int | str] | None = None


def write_geo_lines(path: Path, lines: Sequence[GeoLine]) -> None:
    """Writes the format of the suffix: .geojson, .gpx or .kml. Raises ValueError for another suffix, OSError."""
    encode = {".geojson": _geojson, ".gpx": _gpx, ".kml": _kml}.get(path.suffix.lower())
    if encode is None:
        raise ValueError(f"{path}: expected a suffix of {', '.join(SUFFIXES)}")
    path.write_text(encode([line for line in lines if len(line.degrees) > 1]), encoding="utf-8")


def _geojson(lines: Sequence[GeoLine]) -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"name": line.name, **(line.properties or {})},
            "geometry": {
                "type": "LineString",
                "coordinates": [[round(float(lon), 8), round(float(lat), 8)] for lat, lon in line.degrees],
            },
        }
        for line in lines
    ]
    return msgspec.json.encode({"type": "FeatureCollection", "features": features}).decode() + "\n"


def _gpx(lines: Sequence[GeoLine]) -> str:
    out = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="BirdSLAM" xmlns="http://www.topografix.com/GPX/1/1">',
    ]
    for line in lines:
        out.append(f"<trk><name>{escape(line.name)}</name><trkseg>")
        times = line.t_ns or (0,) * len(line.degrees)
        for (lat, lon), t_ns in zip(line.degrees, times, strict=True):
            time = f"<time>{_time(t_ns)}</time>" if line.t_ns else ""
            out.append(f'<trkpt lat="{lat:.8f}" lon="{lon:.8f}">{time}</trkpt>')
        out.append("</trkseg></trk>")
    return "\n".join([*out, "</gpx>", ""])


def _time(t_ns: int) -> str:
    return (
        datetime.fromtimestamp(max(t_ns, 0) / NS_PER_S, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    )


def _kml(lines: Sequence[GeoLine]) -> str:
    out = ['<?xml version="1.0" encoding="UTF-8"?>', '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>']
    for line in lines:
        data = "".join(
            f"<Data name={quoteattr(key)}><value>{escape(str(value))}</value></Data>"
            for key, value in (line.properties or {}).items()
        )
        out.append(f"<Placemark><name>{escape(line.name)}</name>")
        if data:
            out.append(f"<ExtendedData>{data}</ExtendedData>")
        out.append("<LineString><tessellate>1</tessellate><coordinates>")
        out.append(" ".join(f"{lon:.8f},{lat:.8f}" for lat, lon in line.degrees))
        out.append("</coordinates></LineString></Placemark>")
    return "\n".join([*out, "</Document></kml>", ""])
