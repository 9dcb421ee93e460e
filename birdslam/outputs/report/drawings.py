"""The plots of the report as plotly traces: the drive from above and on Earth, its speed and its statuses."""

from __future__ import annotations

import html
import math
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.outputs.plain_words import meaning
from birdslam.outputs.report.drive_table import DriveTable, EarthTable, TrackTable
from birdslam.outputs.report.wording import frame_words, invalidates, status_names
from birdslam.types import Status

SPEED_WINDOW_S = 0.5  # of the moving average of the speed
MAX_POINTS = 4000  # of a line
MAX_TRACK_POINTS = 200
# The kind of a frame is the first one that applies
KINDS = (
    ("not valid", "#d1342f"),
    ("stationary", "#8b95a5"),
    ("valid, with other statuses", "#e0a100"),
    ("valid", "#1f9d6b"),
)
# Not reported as remarks: the networks run on a part of the frames by schedule
BY_SCHEDULE = {each.value for each in (Status.DETECTIONS_CARRIED, Status.SEGMENTATION_CARRIED, Status.DEPTH_CARRIED)}
TRACK_COLOURS = {"vehicles": "#5b7fd6", "people": "#c455b8"}
LINE_COLOUR, LANDMARK_COLOUR = "#b48a00", "#8b95a5"

Trace = dict[str, Any]


def thinned(count: int, max_count: int = MAX_POINTS) -> Ints:
    """Returns the indices of at most `max_count` of `count` rows, at equal intervals."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).astype(np.int64))


def rounded(values: Floats, digits: int = 3) -> list[float | None]:
    """Rounds values for JSON, with null for NaN."""
    return [round(float(value), digits) if np.isfinite(value) else None for value in values]


def from_above(drive: DriveTable, shown: Ints) -> list[Trace]:
    """Returns the drive in the plane: x up, y left."""
    traces = [_points("road landmarks", *_up(drive.landmarks_m), LANDMARK_COLOUR, 2)]
    if drive.lines:
        traces.append(_broken_line("lines", [_up(xy_m) for _, xy_m in drive.lines], LINE_COLOUR, 2.0))
    else:
        traces.append(_points("lanes", *_up(drive.lanes_m), LINE_COLOUR, 3))
    for kind, people in (("vehicles", False), ("people", True)):
        own = [track for track in drive.tracks if track.is_person is people]
        traces += [_track(track, kind, first=track is own[0]) for track in own]
    return [trace for trace in (*traces, *_ego_path(drive, shown, *_up(drive.xy_m[shown]))) if len(trace["x"])]


def on_earth(drive: DriveTable, earth: EarthTable, shown: Ints) -> list[Trace]:
    """Returns the drive in longitude and latitude in degrees, north up."""
    kinds = (("road lines", earth.road_deg, LINE_COLOUR), ("vehicles", earth.tracks_deg, TRACK_COLOURS["vehicles"]))
    traces = [
        _broken_line(name, [_east(line) for line in lines], colour, 1.5, 7) for name, lines, colour in kinds if lines
    ]
    return [*traces, *_ego_path(drive, shown, *_east(earth.at(drive.t_s[shown])), digits=7)]


def aspect_ratio(earth: EarthTable) -> float:
    """Returns the length of a degree of latitude over that of a degree of longitude."""
    return 1.0 / math.cos(math.radians(float(earth.degrees[0, 0])))


def speeds(drive: DriveTable, shown: Ints) -> list[Trace]:
    """Returns the speed with its sigma; invalid frames are red."""
    speed, t_s = smoothed_speed(drive)[shown], drive.t_s[shown]
    sigma = speed * drive.scale_sigma_rel[shown]
    is_valid = drive.valid[shown] & np.isfinite(speed)
    # One closed outline per interval: plotly would fill a band between two lines across the gaps
    x, y = [], []
    for begin, end in drive.intervals(is_valid):
        span = slice(begin, end)
        x += [t_s[span], t_s[span][::-1], [np.nan]]
        y += [(speed + sigma)[span], (speed - sigma)[span][::-1], [np.nan]]
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "x": rounded(np.concatenate([*x, []])),
            "y": rounded(np.concatenate([*y, []])),
            "line": {"width": 0},
            "hoverinfo": "skip",
            "fill": "toself",
            "fillcolor": "rgba(31,157,107,0.25)",
            "name": "1 sigma",
        },
        _speed_line("speed", t_s, np.where(is_valid, speed, np.nan), KINDS[3][1]),
        _speed_line("not valid", t_s, np.where(is_valid, np.nan, speed), KINDS[0][1]),
    ]


def statuses(drive: DriveTable) -> list[Trace]:
    """Returns a bar over time for each status; invalidating ones are red."""
    traces = []
    for name in status_names(drive):
        is_set = np.array([name in here for here in drive.statuses])
        x: list[float | None] = []
        for begin, end in drive.intervals(is_set):
            x += [round(float(drive.t_s[begin]), 2), round(float(drive.t_s[end - 1] + drive.step_s), 2), None]
        words = html.escape(f"{name}: {meaning(name)}")
        traces.append(
            {
                "name": words,
                "type": "scatter",
                "mode": "lines",
                "x": x,
                "y": [html.escape(name)] * len(x),
                "line": {"width": 9, "color": KINDS[0 if invalidates(name) else 2][1]},
                "hovertemplate": f"{words}<br>%{{x:.1f}} s<extra></extra>",
                "showlegend": False,
            }
        )
    return traces


def smoothed_speed(drive: DriveTable) -> Floats:
    """Returns the moving average (N,) over SPEED_WINDOW_S of the known speeds."""
    window = np.ones(max(1, round(SPEED_WINDOW_S / max(drive.step_s, 1e-3))))
    known = np.isfinite(drive.speed_mps)
    total = np.convolve(np.where(known, drive.speed_mps, 0.0), window, mode="same")[: len(known)]
    count = np.convolve(known.astype(np.float64), window, mode="same")[: len(known)]
    out: Floats = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
    return out


def _up(xy_m: Floats) -> tuple[Floats, Floats]:
    """Converts x and y to the right and up axes of the picture."""
    return -xy_m[:, 1], xy_m[:, 0]


def _east(degrees: Floats) -> tuple[Floats, Floats]:
    return degrees[:, 1], degrees[:, 0]


def _ego_path(drive: DriveTable, shown: Ints, right: Floats, up: Floats, digits: int = 3) -> list[Trace]:
    """Returns the ego trajectory, coloured by the kind of each frame."""
    kinds, traces = np.array([_kind(drive, k) for k in shown]), []
    for number, (name, colour) in enumerate(KINDS):
        here = kinds == number
        if here.any():
            words = {"text": [frame_words(drive, k) for k in shown[here]], "hoverinfo": "text"}
            traces.append(_points(f"ego: {name}", right[here], up[here], colour, 6, digits) | words)
    return traces


def _kind(drive: DriveTable, k: int) -> int:
    if not drive.valid[k]:
        return 0
    if Status.STANDSTILL.value in drive.statuses[k]:
        return 1
    return 2 if set(drive.statuses[k]) - BY_SCHEDULE else 3


def _points(name: str, right: Floats, up: Floats, colour: str, size: int, digits: int = 3) -> Trace:
    return {
        "name": name,
        "type": "scatter",
        "mode": "markers",
        "x": rounded(right, digits),
        "y": rounded(up, digits),
        "marker": {"color": colour, "size": size},
        "hoverinfo": "skip",
    }


def _broken_line(name: str, lines: list[tuple[Floats, Floats]], colour: str, width: float, digits: int = 3) -> Trace:
    """Returns many lines as one trace, with gaps between them."""
    x: list[float | None] = []
    y: list[float | None] = []
    for right, up in lines:
        x += [*rounded(right, digits), None]
        y += [*rounded(up, digits), None]
    line = {"color": colour, "width": width}
    return {
        "name": name, "type": "scatter", "mode": "lines", "x": x, "y": y, "line": line, "hoverinfo": "skip",
        "connectgaps": False,
    }  # fmt: skip


def _track(track: TrackTable, kind: str, first: bool) -> Trace:
    rows = thinned(len(track.t_s), MAX_TRACK_POINTS)
    label = html.escape(f"{track.label} {track.name}")
    right, up = _up(track.xy_m[rows])
    return {
        "name": kind,
        "legendgroup": kind,
        "showlegend": first,
        "type": "scatter",
        "mode": "lines+markers",
        "x": rounded(right),
        "y": rounded(up),
        "line": {"width": 1.5, "color": TRACK_COLOURS[kind]},
        "marker": {"size": 3, "color": TRACK_COLOURS[kind]},
        "text": [f"{label}, {t:.1f} s" for t in track.t_s[rows]],
        "hoverinfo": "text",
    }


def _speed_line(name: str, t_s: Floats, speed: Floats, colour: str) -> Trace:
    line = {"name": name, "type": "scatter", "mode": "lines", "line": {"color": colour, "width": 2}}
    return {**line, "x": rounded(t_s), "y": rounded(speed), "hovertemplate": "%{y:.1f} m/s<extra></extra>"}
