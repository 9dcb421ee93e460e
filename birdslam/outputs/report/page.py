"""Writes the report as one HTML page: the drive from above, speed, statuses and pictures, with one slider.

The page contains the JavaScript of plotly, so that it opens offline. All text from files is escaped.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path

import cv2

from birdslam.outputs.drive_files import ResultsError
from birdslam.outputs.report import drawings, wording
from birdslam.outputs.report.drawings import rounded
from birdslam.outputs.report.drive_table import DriveTable
from birdslam.outputs.report.ruler import ruler

REPORT = "report.html"
STYLE, SCRIPT = (Path(__file__).parent / name for name in ("page.css", "page.js"))
_RULER = (
    '<p id="ruler">Click two points of the road to measure their distance. True length: '
    '<input id="length" type="number" min="0" step="0.01" aria-label="true length in metres"> m '
    '<output id="measured"></output></p>'
)
MAX_PICTURES, PICTURE_WIDTH_PX, JPEG_QUALITY = 150, 900, 68  # of the video, about 6 MB


def plotly_script() -> str:
    """Returns the JavaScript of plotly. Raises ResultsError if plotly is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ResultsError("a report needs plotly: pip install 'birdslam[report]'") from None
    return str(get_plotlyjs())


def report_page(drive: DriveTable, video: Path | None = None, plotly: str = "") -> str:
    """Returns the page. Its pictures are from `video`, the file of `--video`.

    `plotly` is the URL of a JavaScript file that several pages share; "" puts the script into the page. Raises
    ResultsError if plotly is not installed.
    """
    script = f'<script src="{html.escape(plotly)}"></script>' if plotly else f"<script>{plotly_script()}</script>"
    pictures, video_px = _pictures(video) if video is not None and video.is_file() else ([], (0, 0))
    road = ruler(drive.camera, video_px, PICTURE_WIDTH_PX) if pictures else None
    name = html.escape(drive.name)
    film = f'<figure id="film"><img id="picture" alt="video frame at this time">{_RULER if road else ""}</figure>'
    return "\n".join(
        (
            "<!doctype html>",
            f'<html lang="en"><head><meta charset="utf-8"><title>BirdSLAM: {name}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{STYLE.read_text(encoding='utf-8')}</style></head><body>",
            f"<header><h1>{name}</h1><p>{wording.facts(drive)}</p></header>",
            f'<section class="verdict"><h2>Validity and accuracy</h2><ul>{wording.verdict(drive)}</ul></section>',
            f'<main><section id="map" class="plot"></section>{film if pictures else ""}</main>',
            '<section class="slider"><input id="at" type="range" min="0" step="1" value="0" aria-label="time">'
            '<output id="words"></output></section>',
            '<section id="speed" class="plot low"></section><section id="statuses" class="plot low"></section>',
            *_sections(drive),
            script,
            f'<script type="application/json" id="data">{_json({**_data(drive, pictures), "ruler": road})}</script>',
            f"<script>{SCRIPT.read_text(encoding='utf-8')}</script></body></html>",
        )
    )


def _sections(drive: DriveTable) -> list[str]:
    """Returns the sections below the plots."""
    out = [("Invalid frames", _table(wording.invalid_rows(drive)))]
    out.append(("Statuses", _table(wording.status_rows(drive))))
    if drive.summary.get("stages_ms"):
        out.append(("Latency, capture to planner", _table(wording.latency_rows(drive))))
    if drive.earth is not None:
        out.append(("On Earth", wording.earth_words(drive, drive.earth) + '<div id="earth" class="plot"></div>'))
    out.append(("Downloads", f'<p class="files">{wording.downloads(drive)}</p>'))
    out.append(("Camera and versions", wording.details(drive)))
    return [f"<section><h2>{heading}</h2>{text}</section>" for heading, text in out]


def _table(rows: str) -> str:
    return f"<table>{rows}</table>"


def _data(drive: DriveTable, pictures: list[tuple[float, str]]) -> dict[str, object]:
    """Returns the data of page.js."""
    shown = drawings.thinned(len(drive.t_s))
    data: dict[str, object] = {
        "t": rounded(drive.t_s[shown]),
        "x": rounded(-drive.xy_m[shown, 1]),  # picture axes: x up, y left
        "y": rounded(drive.xy_m[shown, 0]),
        "words": [wording.frame_words(drive, k) for k in shown],
        "map": drawings.from_above(drive, shown),
        "speeds": drawings.speeds(drive, shown),
        "statuses": drawings.statuses(drive),
        "pictures": [{"t": round(t_s, 2), "jpeg": jpeg} for t_s, jpeg in pictures],
    }
    if drive.earth is not None:
        at = drive.earth.at(drive.t_s[shown])
        data["earth"] = {
            "x": rounded(at[:, 1], 7),
            "y": rounded(at[:, 0], 7),
            "traces": drawings.on_earth(drive, drive.earth, shown),
            "aspect_ratio": round(drawings.aspect_ratio(drive.earth), 5),
        }
    return data


def _pictures(video: Path) -> tuple[list[tuple[float, str]], tuple[int, int]]:
    """Returns (time in s, JPEG as base64) of pictures at equal intervals, and the size of the video.

    Not every browser plays the codec.
    """
    capture = cv2.VideoCapture(str(video))
    size_px = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    count, hz = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
    every, out, number = max(1, -(-count // MAX_PICTURES)), [], 0
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
    return out, size_px


def _json(data: object) -> str:
    """Encodes data for a script element: without characters that end the element or begin a comment."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
