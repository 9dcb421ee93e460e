"""Prior knowledge of a camera: intrinsics, lengths, field of view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from birdslam.calibration.camera_files import read_intrinsics
from birdslam.calibration.intrinsics import Intrinsics, from_chessboard
from birdslam.calibration.lens import (
    FIELD_OF_VIEW_DEG,
    STATED_SIGMA_REL,
    WIDE_DEG,
    WIDE_SIGMA_REL,
    focal_by_field_of_view,
)
from birdslam.ros.bag import BagTopics
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.nodes.sources import parsed
from birdslam.sources.camera_file import load_camera
from birdslam.sources.recording import DatasetError, Recording

METADATA_SIGMA_REL = 0.1  # of a focal length from metadata, since videos are often cropped; by judgement


class KnownSize(NamedTuple):
    """What `--known-length` states: the width of lanes, or the height of the vehicle in view for most frames."""

    lane_m: float | None = None
    car_height_m: float | None = None


_NO_SIZE = KnownSize()


@dataclass(frozen=True)
class Given:
    """The user's input about the camera: intrinsics from at most one of the first three, and lengths."""

    camera: Path | None = None  # an existing camera file
    intrinsics: Path | None = None  # a calibration file of another project
    chessboard: Path | None = None  # a directory of images
    board: tuple[int, int] = (9, 6)  # the chessboard's inner corners: columns, rows
    square_m: float = 0.025
    height_m: float | None = None
    fov_deg: float | None = None  # horizontal field of view, for an unknown lens
    fov_sigma_percent: float | None = None  # 1-sigma of its focal length; None: a nominal field of view
    kind: str = "dashcam"  # kind of camera, if the field of view is unknown too
    speed: Path | None = None  # lines of time in s, speed in m/s
    size: KnownSize = _NO_SIZE


def known_length_of(text: str | None) -> KnownSize:
    """Parses `--known-length`, `lane=3.5` or `car=4.4x1.8x1.45`. Raises ConfigurationError."""
    if text is None:
        return _NO_SIZE
    what, _, numbers = text.partition("=")
    try:
        sizes_m = [float(number) for number in numbers.split("x")]
    except ValueError:
        sizes_m = []
    if what == "lane" and len(sizes_m) == 1 and 2.0 <= sizes_m[0] <= 6.0:
        return KnownSize(lane_m=sizes_m[0])
    if what == "car" and len(sizes_m) in (1, 3) and 1.0 <= sizes_m[-1] <= 4.5:
        return KnownSize(car_height_m=sizes_m[-1])
    raise ConfigurationError(
        f"--known-length {text}: expected lane=METRES, a width of 2 to 6 m, or car=LENGTHxWIDTHxHEIGHT, "
        "a height of 1 to 4.5 m"
    )


def lens_of(given: Given, uri: str, topics: BagTopics) -> tuple[Intrinsics | None, float | None]:
    """Returns the intrinsics, if known before the drive, and the stated height."""
    height_m = given.height_m
    if height_m is not None and not 0.2 <= height_m <= 5.0:
        raise ConfigurationError(f"--height {height_m:g}: expected 0.2 to 5 m above the road")
    if given.camera is not None:
        old = load_camera(given.camera)
        names = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion", "fisheye", "distortion_sigma")
        numbers = {name: getattr(old, name) for name in names}
        lens = Intrinsics(**numbers, width_px=old.width_px, height_px=old.height_px, source=str(given.camera))
        return lens, height_m or old.height_m
    if given.intrinsics is not None:
        return read_intrinsics(given.intrinsics), height_m
    if given.chessboard is not None:
        return from_chessboard(given.chessboard, *given.board, given.square_m), height_m
    kind, path = class_and_path(uri)
    own = kind.own_lens(path, topics)
    if own is not None:
        return Intrinsics(**own.lens._asdict(), source=own.source), height_m or own.height_m
    return None, height_m


class FocalLength(NamedTuple):
    """The prior of a focal length: value, 1-sigma as a fraction, and source."""

    px: float
    sigma_rel: float
    by: str
    by_view: bool = True  # from a horizontal field of view, which may or may not include distortion
    fisheye: bool = False  # about equidistant: too wide for a pinhole model


def focal_length_of(given: Given, uri: str, size_px: tuple[int, int]) -> FocalLength:
    """Returns the focal length as stated, from metadata, or from the kind of camera. Raises ConfigurationError.

    The field of view of a kind is that across the longer side of the image: phones are also held upright.
    """
    width_px = size_px[0]
    if given.fov_deg is not None:
        if not 10.0 <= given.fov_deg <= 150.0:
            raise ConfigurationError(f"--fov {given.fov_deg:g}: expected a field of view of 10 to 150 deg")
        words, fisheye = f"as stated, {given.fov_deg:g} deg across", given.fov_deg >= WIDE_DEG
        focal_px = focal_by_field_of_view(width_px, given.fov_deg, fisheye)
        if given.fov_sigma_percent is not None:
            if not 0.1 <= given.fov_sigma_percent <= 50.0:
                raise ConfigurationError(f"--fov-sigma {given.fov_sigma_percent:g}: expected 0.1 to 50 per cent")
            return FocalLength(focal_px, 0.01 * given.fov_sigma_percent, words, by_view=False, fisheye=fisheye)
        return FocalLength(focal_px, WIDE_SIGMA_REL if fisheye else STATED_SIGMA_REL, words, fisheye=fisheye)
    if given.fov_sigma_percent is not None:
        raise ConfigurationError("--fov-sigma: needs --fov")
    kind, path = class_and_path(uri)
    stated_px = kind.stated_focal_px(path)
    if stated_px is not None and focal_by_field_of_view(width_px, 150.0) < stated_px:
        by = f"from the video's metadata, {stated_px:.0f} px"
        return FocalLength(stated_px, METADATA_SIGMA_REL, by, by_view=False)
    fov_deg, sigma_rel = FIELD_OF_VIEW_DEG[given.kind]
    focal_px = focal_by_field_of_view(max(size_px), fov_deg)
    return FocalLength(focal_px, sigma_rel, f"that of a {given.kind}, {fov_deg:g} deg across")


def class_and_path(uri: str) -> tuple[type[Recording], Path]:
    """Returns the class that reads a source's URI, and its path."""
    scheme, address = parsed(uri)
    return scheme.load(), Path(address).expanduser()


def frame_size(uri: str, topics: BagTopics) -> tuple[int, int] | None:
    """Returns (width, height) of the recording's frames in pixels; None if unknown."""
    kind, path = class_and_path(uri)
    try:
        return kind.frame_size(path, topics)
    except DatasetError:  # opening it raises the error
        return None
