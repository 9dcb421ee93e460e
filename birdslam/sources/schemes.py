"""Table of source schemes (`kitti:DIR`): description, camera, clock and the class that opens each.

Commands, pages and messages about sources use this table; a new source is a `Recording` class and an entry here. The
classes are named, not imported, so that help texts load neither OpenCV nor rosbags. runtime/schemes.py adds live
sources.
"""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

OF_A_RECORDING = ("stride", "speed", "odometry", "detections", "detector", "loop", "prefetch_frames")
MCAP_HEAD_BYTES = 64  # the first record has the profile: "ros2" in a bag, "" in a birdslam recording


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A kind of source. Its addresses begin with `name:`."""

    name: str
    written: tuple[str, ...]  # notation for users; a name without a colon takes no address
    what: str
    opener: str  # module:class; called with (path, camera=, stride=); if `live` with (configuration, must_open)
    camera: Literal["calibration", "intrinsics", "frame size", "nothing"]  # intrinsics: without the height
    clock: Literal["recorded times", "frame rate", "this computer's"]
    address: Literal["path", "device", "network", "topic"] = "path"
    live: bool = False
    options: tuple[str, ...] = OF_A_RECORDING  # accepted keys of [source]; uri, rate and frames hold for all
    refused: tuple[str, ...] = ()  # keys that raise an error; others are ignored
    suffixes: tuple[str, ...] = ()  # file suffixes of this source
    is_at: Callable[[Path], bool] = lambda path: False  # recognises a path without such a suffix
    recognised: str = ""  # description of `is_at`

    def load(self) -> Any:
        """Imports and returns the class that opens it."""
        return pkgutil.resolve_name(self.opener)


def _is_bag(path: Path) -> bool:
    """A directory of `ros2 bag record`, or an MCAP file written by ROS."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix.lower() != ".mcap":
        return False
    try:
        with path.open("rb") as file:
            return b"ros" in file.read(MCAP_HEAD_BYTES)
    except OSError:
        return False


def _is_kitti(path: Path) -> bool:
    from birdslam.sources.kitti import find_layout
    from birdslam.sources.recording import DatasetError

    try:
        return bool(find_layout(path))
    except DatasetError:
        return False


def _is_raw_stream(path: Path) -> bool:
    from birdslam.sources.films.container import is_raw_stream

    return path.is_file() and is_raw_stream(path)


DEMO = Scheme(
    name="demo",
    written=("demo", "demo:DIR"),
    what="the drive that ships with birdslam; DIR: another drive of the built-in world",
    opener="birdslam.sources.shipped_drive:DemoRecording",
    camera="calibration",
    clock="frame rate",
)
VIDEO = Scheme(
    name="video",
    written=("video:FILE", "video:DIR"),
    what="a film readable by OpenCV; DIR: all its films in the order of their names",
    opener="birdslam.sources.films.video:VideoRecording",
    camera="frame size",
    clock="recorded times",
    refused=("topics",),
    suffixes=(".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".ts", ".m2ts", ".mts", ".mpg", ".3gp", ".flv", ".wmv"),
    is_at=_is_raw_stream,  # and refuses it with the command that gives it a container
)
ROSBAG = Scheme(
    name="rosbag",
    written=("rosbag:PATH",),
    what="a ROS bag, of ROS 2 (directory, .mcap, .db3) or ROS 1 (.bag): [ros.md](ros.md)",
    opener="birdslam.sources.rosbag:RosbagRecording",
    camera="intrinsics",
    clock="recorded times",
    options=(*OF_A_RECORDING, "topics"),
    suffixes=(".bag", ".db3"),
    is_at=_is_bag,
    recognised="a directory with metadata.yaml, an .mcap file written by ROS",
)
KITTI = Scheme(
    name="kitti",
    written=("kitti:DIR",),
    what="a KITTI directory: odometry sequence, tracking sequence, raw drive or clip",
    opener="birdslam.sources.kitti:KittiRecording",
    camera="calibration",
    clock="recorded times",
    refused=("topics",),
    is_at=_is_kitti,
    recognised="a directory with KITTI's image folders",
)
# The first match wins
RECORDED = (DEMO, VIDEO, ROSBAG, KITTI)


def written(schemes: Sequence[Scheme]) -> str:
    """All schemes in the notation for users, for help and messages."""
    return ", ".join(text for scheme in schemes for text in scheme.written)


def scheme_of(uri: str, schemes: Sequence[Scheme]) -> Scheme | None:
    """The scheme of the name before the colon, or None."""
    name = uri.partition(":")[0]
    return next((scheme for scheme in schemes if scheme.name == name), None)


def parse(uri: str, schemes: Sequence[Scheme]) -> tuple[Scheme, str]:
    """Returns the scheme and address of a URI. Raises ValueError with the known schemes."""
    scheme, (name, colon, address) = scheme_of(uri, schemes), uri.partition(":")
    if scheme is None:
        raise ValueError(f"{uri}: unknown source {name + colon!r}; choose from {written(schemes)}")
    if not address and scheme.name not in scheme.written:
        raise ValueError(f"{uri}: has no address; expected {' or '.join(scheme.written)}")
    return scheme, address


def scheme_at(path: Path, schemes: Sequence[Scheme]) -> Scheme | None:
    """The scheme of an existing path, or None."""
    by_name = None if path.is_dir() else by_suffix(path, schemes)
    return by_name or next((scheme for scheme in schemes if scheme.is_at(path)), None)


def by_suffix(path: Path, schemes: Sequence[Scheme]) -> Scheme | None:
    """The scheme of a file's suffix, or None."""
    return next((scheme for scheme in schemes if path.suffix.lower() in scheme.suffixes), None)


def uri_of(text: str, schemes: Sequence[Scheme]) -> str:
    """Returns the URI of a source, given a URI or the path of a recording. Raises ValueError with the known schemes."""
    if scheme_of(text, schemes) is not None:
        return text
    path = Path(text).expanduser()
    if not path.exists() and re.match(r"\w{2,}:", text):  # an address: `parse` names the schemes
        return text
    if not path.exists():
        raise ValueError(f"{text}: there is no such file, and no such source; expected a path or {written(schemes)}")
    found = scheme_at(path, schemes)
    if found is None and path.is_dir():
        inside = [file.name for file in path.iterdir() if not file.is_dir() and scheme_at(file, (ROSBAG,))]
        if inside:
            raise ValueError(f"{text}: has no metadata.yaml; name one of its bags: {', '.join(sorted(inside))}")
        found = VIDEO
    if found is None:
        kinds = [scheme for scheme in schemes if scheme.address == "path" and not scheme.live]
        raise ValueError(f"{text}: not recognized; name its kind: {written(kinds)}")
    return f"{found.name}:{text}"
