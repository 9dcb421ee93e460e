"""The tables of docs/sources.md, generated from the schemes; `birdslam sources` prints them."""

from __future__ import annotations

from birdslam.runtime.pages.tables import table
from birdslam.runtime.schemes import all_schemes
from birdslam.sources.schemes import Scheme

_PAGE = """\
## All sources

{what}

*Camera*: with *calibration* the source has the whole camera; with *intrinsics* the camera height may be missing; with
*frame size* or *nothing* a camera file is needed. `--camera FILE` replaces what the source provides. *Clock*: *recorded
times* are those of each frame, or follow the frame rate where a recording has none; *this computer's* is the time of
arrival.

{takes}

`uri`, `rate` and `frames` of `[source]` hold for every source; `rate = "max"` is for recordings. Keys that a source
does not take are ignored, or are an error where the table says so. `birdslam batch` accepts a path without a scheme and
uses the first source that recognises it; `calibrate` and `evaluate` take such a path as a KITTI directory.
"""


def page() -> str:
    """Returns the generated section of docs/sources.md in Markdown."""
    schemes = all_schemes()
    what = [("source", "what it is", "frames", "camera", "clock"), *map(_what, schemes)]
    takes = [
        ("source", "keys of `[source]` that it takes", "that are an error", "a path that is one"),
        *map(_takes, schemes),
    ]
    return _PAGE.format(what=table(what), takes=table(takes))


def _name(scheme: Scheme) -> str:
    return ", ".join(f"`{text}`" for text in scheme.written)


def _what(scheme: Scheme) -> tuple[str, ...]:
    return _name(scheme), scheme.what, "live" if scheme.live else "recorded", scheme.camera, scheme.clock


def _takes(scheme: Scheme) -> tuple[str, ...]:
    recognised = ", ".join([*scheme.suffixes, *filter(None, [scheme.recognised])])
    return _name(scheme), _keys(scheme.options), _keys(scheme.refused), recognised or "-"


def _keys(keys: tuple[str, ...]) -> str:
    return ", ".join(f"`{key}`" for key in keys) or "-"
