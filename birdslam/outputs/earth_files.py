"""Ways and places on Earth as GeoJSON (RFC 7946), GPX 1.1 and KML 2.2; WGS 84, degrees."""

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
class Way:
    """A line on Earth: (N, 2) latitude and longitude in degrees; times of the recording, 0 where there are none."""

    name: str
    degrees: Floats
    t_ns: Sequence[int] = ()
    about: dict[str, float | int | str] | None = None


def write_ways(path: Path, ways: Sequence[Way]) -> None:
    """As the file's name says: .geojson, .gpx or .kml. Raises ValueError for another, OSError."""
    made = {".geojson": _geojson, ".gpx": _gpx, ".kml": _kml}.get(path.suffix.lower())
    if made is None:
        raise ValueError(f"{path}: a place on Earth is written as {', '.join(SUFFIXES)}")
    path.write_text(made([way for way in ways if len(way.degrees) > 1]), encoding="utf-8")


def _geojson(ways: Sequence[Way]) -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"name": way.name, **(way.about or {})},
            "geometry": {
                "type": "LineString",
                "coordinates": [[round(float(lon), 8), round(float(lat), 8)] for lat, lon in way.degrees],
            },
        }
        for way in ways
    ]
    return msgspec.json.encode({"type": "FeatureCollection", "features": features}).decode() + "\n"


def _gpx(ways: Sequence[Way]) -> str:
    out = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="BirdSLAM" xmlns="http://www.topografix.com/GPX/1/1">',
    ]
    for way in ways:
        out.append(f"<trk><name>{escape(way.name)}</name><trkseg>")
        times = way.t_ns or (0,) * len(way.degrees)
        for (lat, lon), t_ns in zip(way.degrees, times, strict=True):
            time = f"<time>{_time(t_ns)}</time>" if way.t_ns else ""
            out.append(f'<trkpt lat="{lat:.8f}" lon="{lon:.8f}">{time}</trkpt>')
        out.append("</trkseg></trk>")
    return "\n".join([*out, "</gpx>", ""])


def _time(t_ns: int) -> str:
    return (
        datetime.fromtimestamp(max(t_ns, 0) / NS_PER_S, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    )


def _kml(ways: Sequence[Way]) -> str:
    out = ['<?xml version="1.0" encoding="UTF-8"?>', '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>']
    for way in ways:
        data = "".join(
            f"<Data name={quoteattr(key)}><value>{escape(str(value))}</value></Data>"
            for key, value in (way.about or {}).items()
        )
        out.append(f"<Placemark><name>{escape(way.name)}</name>")
        if data:
            out.append(f"<ExtendedData>{data}</ExtendedData>")
        out.append("<LineString><tessellate>1</tessellate><coordinates>")
        out.append(" ".join(f"{lon:.8f},{lat:.8f}" for lat, lon in way.degrees))
        out.append("</coordinates></LineString></Placemark>")
    return "\n".join([*out, "</Document></kml>", ""])
