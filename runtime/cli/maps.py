"""`birdslam map`: inspects, merges, trims, draws and exports maps."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from birdslam.loops.merging import merged, part
from birdslam.outputs.map_picture import draw_map
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.maps.map_export import FORMATS, export_map
from birdslam.runtime.maps.map_store import read_map, write_map

MAP = "FILE.map"


def add_map_argument(parser: argparse.ArgumentParser) -> None:
    """Adds the map."""
    parser.add_argument("map", type=Path, metavar=MAP)


def info(options: argparse.Namespace) -> int:
    """Prints the contents of a map."""
    place_map = read_map(options.map)
    size = options.map.stat().st_size
    poses = place_map.poses()
    loops = sum(link.loop for link in place_map.links)
    earth = place_map.earth
    camera = place_map.camera
    rows = [
        ("keyframes", f"{len(place_map)} of {place_map.drives} drives"),
        ("points", str(sum(len(keyframe.points_m) for keyframe in place_map.keyframes))),
        ("length", f"{place_map.length_m:.0f} m, {len(place_map.links) - loops} odometry links and {loops} loop links"),
        ("lines", str(len(place_map.lines()))),
        ("size", f"{size / 1e6:.3f} MB, {size / 1e3 / max(place_map.length_m, 1.0):.2f} MB per km"),
        ("words", str(0 if place_map.words is None else len(place_map.words))),
        (
            "camera",
            f"{camera.width_px}x{camera.height_px}, fx {camera.fx_px:g} px, {camera.height_m:g} m above the road",
        ),
        ("camera digest", camera.digest),
        (
            "on Earth",
            "no"
            if earth is None
            else f"{earth.latitude_deg:.6f}, {earth.longitude_deg:.6f}; {earth.fixes - earth.outliers} keyframes have "
            f"fixes, RMS {earth.rms_m:.2f} m",
        ),
    ]
    if len(poses):
        low, high = poses.min(axis=0), poses.max(axis=0)
        rows.append(("extent", f"x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to {high[1]:.0f} m"))
    print("\n".join(f"{name:14}{value}" for name, value in rows))
    return 0


def add_merge_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds two maps and the output."""
    parser.add_argument("map", type=Path, metavar=MAP, help="map that defines the frame of the result")
    parser.add_argument("other", type=Path, metavar="OTHER.map")
    parser.add_argument("--output", type=Path, required=True, metavar=MAP)


def merge(options: argparse.Namespace) -> int:
    """Merges two maps that share streets."""
    out, found = merged(read_map(options.map), read_map(options.other))
    size = write_map(options.output, out)
    print(
        f"{options.output}: {len(out)} keyframes, {size / 1e6:.2f} MB; {found} of {options.other} are in {options.map}"
    )
    return 0


def add_trim_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the map, the part to keep and the output."""
    add_map_argument(parser)
    parser.add_argument("--output", type=Path, required=True, metavar=MAP)
    which = parser.add_mutually_exclusive_group(required=True)
    text = "keep keyframes within a radius of a point, in metres"
    which.add_argument("--within", type=float, nargs=3, metavar=("X", "Y", "RADIUS"), help=text)
    which.add_argument("--without-drive", type=int, metavar="N", help="remove the keyframes of one drive")


def trim(options: argparse.Namespace) -> int:
    """Writes a part of a map."""
    place_map = read_map(options.map)
    if options.within is not None:
        x_m, y_m, radius_m = options.within

        def keeps(keyframe: object) -> bool:
            T = keyframe.T_map_keyframe  # type: ignore[attr-defined]
            return math.hypot(T.x_m - x_m, T.y_m - y_m) <= radius_m
    else:

        def keeps(keyframe: object) -> bool:
            return bool(keyframe.drive != options.without_drive)  # type: ignore[attr-defined]

    out = part(place_map, keeps)
    if not len(out):
        raise ConfigurationError(f"{options.map}: the trimmed map would be empty ({len(place_map)} keyframes removed)")
    size = write_map(options.output, out)
    print(f"{options.output}: {len(out)} of {len(place_map)} keyframes, {size / 1e6:.2f} MB")
    return 0


def add_picture_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the map and the picture."""
    add_map_argument(parser)
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.png")


def picture(options: argparse.Namespace) -> int:
    """Draws a map from above."""
    try:
        draw_map(read_map(options.map), options.output)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{options.output}: can't be drawn: {error}") from None
    print(options.output)
    return 0


def add_export_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the map and the output file."""
    add_map_argument(parser)
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=f"file to write: {FORMATS}",
    )


def export(options: argparse.Namespace) -> int:
    """Exports a map to another format."""
    print(f"{options.output}: {export_map(read_map(options.map), options.output)}")
    return 0
