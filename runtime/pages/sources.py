"""The page of all sources (docs/sources.md), made from the table of schemes: `birdslam sources` prints it."""

from __future__ import annotations

from birdslam.runtime.pages.tables import table
from birdslam.runtime.schemes import all_schemes
from birdslam.sources.schemes import Scheme

_PAGE = """\
# Where frames come from

Made by `birdslam sources > docs/sources.md` from the tables in `birdslam/sources/schemes.py` and `runtime/schemes.py`;
a test holds it to the code. `birdslam run --source URI` takes any of them, `calibrate`, `batch` and `evaluate` those
that are recorded.

{what}

**Camera.** *calibration*: the source says all of its camera. *intrinsics*: the camera's height over the road may be
missing. *frame size* and *nothing*: a camera file is needed (`--camera FILE`, [calibration.md](calibration.md)), which
goes before what any source says.

**Clock.** *recorded times* are those of each frame; where a recording has none, frames follow each other at its frame
rate. *frame rate*: they always do. *this computer's*: a frame bears the time at which it came.

{takes}

`uri`, `rate` and `frames` of `[source]` hold for every source ([configuration.md](configuration.md)); `rate = "max"` is
for recordings. Other keys that a source does not take are ignored.
A path without a scheme is for `birdslam batch` the first of these that recognises it, for `calibrate` and `evaluate` a
KITTI directory.
"""


def page() -> str:
    """The whole page, in Markdown."""
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
