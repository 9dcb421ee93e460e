"""The report as one page of HTML: the drive from above, its speed, its statuses, its pictures, all on one slider.

By plotly, whose JavaScript is in the page, so that it opens offline. Whatever comes from a file is escaped.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.outputs.drive_files import ResultsError
from birdslam.outputs.plain_words import MEANINGS, meaning
from birdslam.outputs.report.drive_table import FILES, DriveTable, TrackTable
from birdslam.types import INVALIDATING, Status

REPORT = "report.html"  # beside the results
STYLE, SCRIPT = (Path(__file__).parent / name for name in ("page.css", "page.js"))
PICTURES, PICTURE_WIDTH_PX, JPEG_QUALITY = 150, 900, 68  # of the video, some 6 MB
SMOOTHED_S = 0.5  # over which the speed that is drawn is a mean
MOST_POINTS = 4000  # of a line
# A frame is of the first of these that it fits; colour in light and in dark
KINDS = (("not valid", "#d1342f"), ("stands", "#8b95a5"), ("valid, with remarks", "#e0a100"), ("valid", "#1f9d6b"))

TRACK_COLOURS = {"vehicles": "#5b7fd6", "people": "#c455b8"}

Trace = dict[str, Any]


def plotly_script() -> str:
    """plotly's own text. Raises ResultsError where it is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ResultsError("a report needs the extra `report`: pip install 'birdslam[report]'") from None
    return str(get_plotlyjs())


def report_page(drive: DriveTable, video: Path | None = None, plotly: str = "") -> str:
    """The whole page. `video` is that of `--video`, of which pictures are taken.

    `plotly` is the address of its text where many pages share one file; "": it is in the page. Raises ResultsError
    where plotly is not installed.
    """
    script = f'<script src="{html.escape(plotly)}"></script>' if plotly else f"<script>{plotly_script()}</script>"
    pictures = _pictures(video) if video is not None and video.is_file() else []
    shown = _thinned(len(drive.t_s))
    data = {
        "t": _rounded(drive.t_s[shown]),
        "x": _rounded(-drive.xy_m[shown, 1]),  # forward is up, left is to the left
        "y": _rounded(drive.xy_m[shown, 0]),
        "speed": _rounded(_smoothed(drive)[shown]),
        "words": [_frame_words(drive, k) for k in shown],
        "map": _map_traces(drive, shown),
        "speeds": _speed_traces(drive, shown),
        "statuses": _status_traces(drive),
        "pictures": [{"t": round(t_s, 2), "jpeg": jpeg} for t_s, jpeg in pictures],
    }
    name = html.escape(drive.name)
    film = '<figure id="film"><img id="picture" alt="the film at this moment"></figure>' if pictures else ""
    return "\n".join(
        (
            "<!doctype html>",
            f'<html lang="en"><head><meta charset="utf-8"><title>BirdSLAM: {name}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{STYLE.read_text(encoding='utf-8')}</style></head><body>",
            f"<header><h1>{name}</h1><p>{_facts(drive)}</p></header>",
            f'<section class="verdict"><h2>How far to believe it</h2><ul>{_verdict(drive)}</ul></section>',
            f'<main><section id="map" class="plot"></section>{film}</main>',
            '<section class="slider"><input id="at" type="range" min="0" step="1" value="0" aria-label="moment">'
            '<output id="words"></output></section>',
            '<section id="speed" class="plot low"></section><section id="statuses" class="plot low"></section>',
            f"<section><h2>What the statuses mean</h2><table>{_status_rows(drive)}</table></section>",
            f"<section><h2>How long it took, capture to planner</h2><table>{_latency_rows(drive)}</table></section>"
            if drive.summary.get("stages_ms")
            else "",
            f"<section><h2>On Earth</h2>{_earth_words(drive)}</section>" if drive.earth_deg is not None else "",
            f'<section><h2>To take away</h2><p class="files">{_downloads(drive)}</p></section>',
            f"<section><h2>Camera and versions</h2>{_details(drive)}</section>",
            script,
            f'<script type="application/json" id="data">{_json(data)}</script>',
            f"<script>{SCRIPT.read_text(encoding='utf-8')}</script></body></html>",
        )
    )


# --- what is drawn ---


def _map_traces(drive: DriveTable, shown: Ints) -> list[Trace]:
    traces = [
        _points("road landmarks", drive.landmarks_m, "#8b95a5", 2),
        _points("lanes", drive.lanes_m, "#b48a00", 3) if not drive.lines else _lines(drive),
    ]
    for kind, people in (("vehicles", False), ("people", True)):
        own = [track for track in drive.tracks if track.is_person is people]
        traces += [_track(track, kind, first=track is own[0]) for track in own]
    kinds = np.array([_kind(drive, k) for k in shown])
    for number, (name, colour) in enumerate(KINDS):
        here = shown[kinds == number]
        if len(here):
            words = {"text": [_frame_words(drive, k) for k in here], "hoverinfo": "text"}
            traces.append(_points(f"own way: {name}", drive.xy_m[here], colour, 6) | words)
    return [trace for trace in traces if len(trace["x"])]


def _points(name: str, xy_m: Floats, colour: str, size: int) -> Trace:
    return {
        "name": name,
        "type": "scatter",
        "mode": "markers",
        "x": _rounded(-xy_m[:, 1]),
        "y": _rounded(xy_m[:, 0]),
        "marker": {"color": colour, "size": size},
        "hoverinfo": "skip",
    }


def _lines(drive: DriveTable) -> Trace:
    """All of the road's lines as one trace, with gaps between them."""
    x: list[float | None] = []
    y: list[float | None] = []
    for _, xy_m in drive.lines:
        x += [*_rounded(-xy_m[:, 1]), None]
        y += [*_rounded(xy_m[:, 0]), None]
    line = {"color": "#b48a00", "width": 2}
    return {
        "name": "lines", "type": "scatter", "mode": "lines", "x": x, "y": y, "line": line, "hoverinfo": "skip",
        "connectgaps": False,
    }  # fmt: skip


def _track(track: TrackTable, kind: str, first: bool) -> Trace:
    rows = _thinned(len(track.t_s), 200)
    label = html.escape(f"{track.label} {track.name}")
    return {
        "name": kind,
        "legendgroup": kind,
        "showlegend": first,
        "type": "scatter",
        "mode": "lines+markers",
        "x": _rounded(-track.xy_m[rows, 1]),
        "y": _rounded(track.xy_m[rows, 0]),
        "line": {"width": 1.5, "color": TRACK_COLOURS[kind]},
        "marker": {"size": 3, "color": TRACK_COLOURS[kind]},
        "text": [f"{label}, {t:.1f} s" for t in track.t_s[rows]],
        "hoverinfo": "text",
    }


def _speed_traces(drive: DriveTable, shown: Ints) -> list[Trace]:
    speed, t_s = _smoothed(drive)[shown], drive.t_s[shown]
    sigma = speed * drive.scale_sigma_rel[shown]
    sure = drive.valid[shown] & np.isfinite(speed)
    band = {"type": "scatter", "mode": "lines", "x": _rounded(t_s), "line": {"width": 0}, "hoverinfo": "skip"}
    return [
        {**band, "y": _rounded(np.where(sure, speed + sigma, np.nan)), "showlegend": False},
        {
            **band,
            "y": _rounded(np.where(sure, speed - sigma, np.nan)),
            "fill": "tonexty",
            "fillcolor": "rgba(31,157,107,0.25)",
            "name": "1 sigma",
        },
        _speed_line("speed", t_s, np.where(sure, speed, np.nan), "#1f9d6b"),
        _speed_line("not valid", t_s, np.where(sure, np.nan, speed), "#d1342f"),
    ]


def _speed_line(name: str, t_s: Floats, speed: Floats, colour: str) -> Trace:
    line = {"name": name, "type": "scatter", "mode": "lines", "line": {"color": colour, "width": 2}}
    return {**line, "x": _rounded(t_s), "y": _rounded(speed), "hovertemplate": "%{y:.1f} m/s<extra></extra>"}


def _status_traces(drive: DriveTable) -> list[Trace]:
    """A bar over the time of each status, those that make a frame invalid in red."""
    traces = []
    step_s = float(np.median(np.diff(drive.t_s))) if len(drive.t_s) > 1 else 0.1
    for name in _names(drive):
        held = np.array([name in statuses for statuses in drive.statuses])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]])))
        x: list[float | None] = []
        for begin, end in edges.reshape(-1, 2):
            x += [round(float(drive.t_s[begin]), 2), round(float(drive.t_s[end - 1] + step_s), 2), None]
        colour = KINDS[0][1] if _invalidates(name) else KINDS[2][1]
        words = html.escape(f"{name}: {meaning(name)}")
        traces.append(
            {
                "name": words,
                "type": "scatter",
                "mode": "lines",
                "x": x,
                "y": [html.escape(name)] * len(x),
                "line": {"width": 9, "color": colour},
                "hovertemplate": f"{words}<br>%{{x:.1f}} s<extra></extra>",
                "showlegend": False,
            }
        )
    return traces


def _kind(drive: DriveTable, k: int) -> int:
    if not drive.valid[k]:
        return 0
    if Status.STANDSTILL.value in drive.statuses[k]:
        return 1
    return 2 if drive.statuses[k] else 3


def _smoothed(drive: DriveTable) -> Floats:
    """The mean of the speed over SMOOTHED_S, of frames that have one."""
    step_s = float(np.median(np.diff(drive.t_s))) if len(drive.t_s) > 1 else SMOOTHED_S
    window = np.ones(max(1, round(SMOOTHED_S / max(step_s, 1e-3))))
    known = np.isfinite(drive.speed_mps)
    total = np.convolve(np.where(known, drive.speed_mps, 0.0), window, mode="same")[: len(known)]
    count = np.convolve(known.astype(np.float64), window, mode="same")[: len(known)]
    out: Floats = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
    return out


# --- what is written ---


def _frame_words(drive: DriveTable, k: int) -> str:
    speed = drive.speed_mps[k]
    speed_text = "" if np.isnan(speed) else f", {speed:.1f} m/s (+- {drive.scale_sigma_rel[k]:.0%})"
    said = "; ".join(meaning(name) for name in drive.statuses[k])
    state = "valid" if drive.valid[k] else "NOT VALID"
    return html.escape(f"{drive.t_s[k]:.1f} s, frame {drive.frame[k]}{speed_text}: {state}{'; ' if said else ''}{said}")


def _facts(drive: DriveTable) -> str:
    source = html.escape(str(drive.summary.get("source", "")))
    return (
        f"{source}<br>{len(drive.t_s)} frames, {drive.t_s[-1]:.1f} s, {float(drive.summary.get('path_m', 0.0)):.0f} m"
    )


def _verdict(drive: DriveTable) -> str:
    lines = drive.summary.get("verdict")
    return "".join(f"<li>{html.escape(str(line))}</li>" for line in (lines if isinstance(lines, list) else ()))


def _names(drive: DriveTable) -> list[str]:
    """The statuses of the drive, those that make a frame invalid first."""
    there = {name for statuses in drive.statuses for name in statuses}
    return sorted(there, key=lambda name: (not _invalidates(name), name))


def _invalidates(name: str) -> bool:
    return Status(name) in INVALIDATING


def _status_rows(drive: DriveTable) -> str:
    rows = []
    for name in _names(drive):
        count = sum(name in statuses for statuses in drive.statuses)
        frames = f"{count} frame{'s' * (count != 1)}"
        effect = "not valid" if _invalidates(name) else "reported only"
        words = html.escape(MEANINGS[Status(name)])
        rows.append(f"<tr><td>{html.escape(name)}</td><td>{frames}</td><td>{effect}</td><td>{words}</td></tr>")
    return "".join(rows) or "<tr><td>none: all is well</td></tr>"


def _latency_rows(drive: DriveTable) -> str:
    """A row a stage with its bar: p50 dark, to p99 light, by the longest p99."""
    stages, age = drive.summary["stages_ms"], drive.summary.get("age_ms") or {}
    rows = {str(name): one for name, one in stages.items() if isinstance(one, dict)} | {"in all": age}
    most = max((float(one.get("p99", 0.0)) for one in rows.values()), default=0.0) or 1.0
    out = []
    for name, one in rows.items():
        p50, p99 = float(one.get("p50", 0.0)), float(one.get("p99", 0.0))
        bar = f'<i style="width:{p99 / most:.1%}"><b style="width:{p50 / (p99 or 1.0):.1%}"></b></i>'
        words = f"p50 {p50:.1f}, p99 {p99:.1f} ms"
        out.append(f'<tr><td>{html.escape(name)}</td><td>{words}</td><td class="bar">{bar}</td></tr>')
    return "".join(out)


def _earth_words(drive: DriveTable) -> str:
    assert drive.earth_deg is not None
    (lat, lon), (to_lat, to_lon) = drive.earth_deg[0], drive.earth_deg[-1]
    said = drive.summary.get("earth", {})
    fit_of = said if isinstance(said, dict) else {}
    fit = (
        f"; {fit_of['fixes']} fixes, {fit_of['outliers']} left out, RMS {fit_of['rms_m']} m"
        if "rms_m" in fit_of
        else ""
    )
    return f"<p>from {lat:.6f}, {lon:.6f} to {to_lat:.6f}, {to_lon:.6f} (WGS 84){html.escape(fit)}</p>"


def _downloads(drive: DriveTable) -> str:
    out = []
    for name, text in drive.files.items():
        data = base64.b64encode(text.encode()).decode("ascii")
        out.append(f'<a download="{name}" href="data:text/plain;base64,{data}">{name}</a> {FILES[name]}')
    return "<br>".join(out)


def _details(drive: DriveTable) -> str:
    versions = drive.summary.get("versions", {})
    models = drive.summary.get("models", {})
    rows = {**(versions if isinstance(versions, dict) else {})}
    for role, model in (models if isinstance(models, dict) else {}).items():
        rows[f"network, {role}"] = model.get("file", "") if isinstance(model, dict) else ""
    cells = "".join(
        f"<tr><td>{html.escape(str(name))}</td><td>{html.escape(str(value))}</td></tr>" for name, value in rows.items()
    )
    camera = f"<pre>{html.escape(drive.camera)}</pre>" if drive.camera else ""
    return f"{camera}<table>{cells}</table>"


def _pictures(video: Path) -> list[tuple[float, str]]:
    """(time in s, JPEG as base64) of pictures evenly over the video: not every browser plays its codec."""
    capture = cv2.VideoCapture(str(video))
    count, hz = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
    every, out, number = max(1, -(-count // PICTURES)), [], 0
    while capture.grab():
        if number % every == 0:
            ok, image = capture.retrieve()
            if ok:
                scale = min(1.0, PICTURE_WIDTH_PX / image.shape[1])
                small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
                out.append((number / max(hz, 1.0), base64.b64encode(jpeg.tobytes()).decode("ascii")))
        number += 1
    capture.release()
    return out


def _thinned(count: int, most: int = MOST_POINTS) -> Ints:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _rounded(values: Floats) -> list[float | None]:
    return [round(float(value), 3) if np.isfinite(value) else None for value in values]


def _json(data: object) -> str:
    """Inside a script element: nothing in it ends the element or begins a comment."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
