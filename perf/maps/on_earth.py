"""What a run with GNSS left: how its metres compare with the fixes', and whether its GeoJSON is by the standard."""

from __future__ import annotations

from pathlib import Path

import msgspec

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.maps.drive_earth import rows


def measure(ledger: Ledger, folder: Path) -> None:
    """`folder`: what `birdslam run --gnss FILE --output DIR` wrote. Raises PerfError."""
    try:
        import geojson  # a test's: only here
    except ImportError as error:
        raise PerfError("GeoJSON is checked by the library geojson: pip install geojson") from error
    summary = folder / "summary.json"
    try:
        earth = msgspec.json.decode(summary.read_bytes(), type=dict[str, object])["earth"]
    except (OSError, KeyError, msgspec.DecodeError) as error:
        raise PerfError(f"{summary}: is no run with --gnss: {error}") from None
    assert isinstance(earth, dict)
    text = "; ".join(f"{name.strip()}: {said}" for name, said in rows(earth))
    ledger.add(f"{folder.name}: on Earth", text, text=text, **earth)
    for path in sorted(folder.glob("*.geojson")):
        found = geojson.loads(path.read_text())
        errors = found.errors() or "none"
        points = sum(1 for feature in found["features"] for _ in geojson.utils.coords(feature))
        text = f"{len(found['features'])} features, {points} points; errors by geojson {geojson.__version__}: {errors}"
        ledger.add(f"{folder.name}: {path.name}", text, text=text, errors=str(errors))
