"""Camera files: TOML whose keys are the fields of `Camera`."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from pathlib import Path

import msgspec

from birdslam.geometry.camera import Camera
from birdslam.sources.recording import DatasetError


def load_camera(path: Path) -> Camera:
    """The camera of a TOML file whose keys are the fields of `Camera`. Raises DatasetError naming file and key."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Camera)
    except OSError as error:
        raise DatasetError(f"camera file {path}: can't be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        remedy = "`birdslam calibrate RECORDING --intrinsics FILE` imports calibrations of other projects"
        raise DatasetError(f"camera file {path}: not TOML ({error}); {remedy}") from None
    except (ValueError, msgspec.ValidationError) as error:
        raise DatasetError(f"camera file {path}: {error}") from None


def camera_text(camera: Camera, comments: Iterable[str]) -> str:
    """The text of a camera file: all fields at full precision, below comment lines."""
    lines = [f"# {line}" for line in comments]
    # Numbers, booleans and lists have the same form in JSON and TOML
    lines += [f"{key} = {json.dumps(value)}" for key, value in msgspec.to_builtins(camera).items()]
    return "\n".join(lines) + "\n"
