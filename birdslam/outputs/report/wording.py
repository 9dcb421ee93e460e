"""The texts of the report as HTML: frames, statuses, latencies, camera and versions. Text from files is escaped."""

from __future__ import annotations

import base64
import html

import numpy as np

from birdslam.outputs.plain_words import MEANINGS, meaning
from birdslam.outputs.report.drive_table import FILES, DriveTable, EarthTable
from birdslam.types import INVALIDATING, Status

MAX_INTERVALS = 40  # of frames that are not valid


def frame_words(drive: DriveTable, k: int) -> str:
    """Returns the description of one frame."""
    speed = drive.speed_mps[k]
    speed_text = "" if np.isnan(speed) else f", {speed:.1f} m/s (+- {drive.scale_sigma_rel[k]:.0%})"
    meanings = "; ".join(meaning(name) for name in drive.statuses[k])
    state = "valid" if drive.valid[k] else "NOT VALID"
    return html.escape(
        f"{drive.t_s[k]:.1f} s, frame {drive.frame[k]}{speed_text}: {state}{'; ' if meanings else ''}{meanings}"
    )


def facts(drive: DriveTable) -> str:
    """Returns source, frame count, duration and distance."""
    source = html.escape(str(drive.summary.get("source", "")))
    return (
        f"{source}<br>{len(drive.t_s)} frames, {drive.t_s[-1]:.1f} s, {float(drive.summary.get('path_m', 0.0)):.0f} m"
    )


def verdict(drive: DriveTable) -> str:
    """Returns the verdict as list items."""
    lines = drive.summary.get("verdict")
    return "".join(f"<li>{html.escape(str(line))}</li>" for line in (lines if isinstance(lines, list) else ()))


def status_names(drive: DriveTable) -> list[str]:
    """Returns the statuses of the drive, invalidating ones first."""
    there = {name for statuses in drive.statuses for name in statuses}
    return sorted(there, key=lambda name: (not invalidates(name), name))


def invalidates(name: str) -> bool:
    """Whether a frame with this status is invalid."""
    return Status(name) in INVALIDATING


def status_rows(drive: DriveTable) -> str:
    """Returns a table row per status: frames, effect, meaning."""
    rows = []
    for name in status_names(drive):
        count = sum(name in statuses for statuses in drive.statuses)
        effect = "not valid" if invalidates(name) else "reported only"
        words = html.escape(MEANINGS[Status(name)])
        rows.append(f"<tr><td>{html.escape(name)}</td><td>{_frames(count)}</td><td>{effect}</td><td>{words}</td></tr>")
    return "".join(rows) or "<tr><td>none</td></tr>"


def invalid_rows(drive: DriveTable) -> str:
    """Returns a table row per interval of invalid frames: time, count, reasons."""
    intervals, rows = drive.intervals(~drive.valid), []
    for begin, end in intervals[:MAX_INTERVALS]:
        why = dict.fromkeys(name for here in drive.statuses[begin:end] for name in here if invalidates(name))
        when = f"{drive.t_s[begin]:.1f} to {drive.t_s[end - 1] + drive.step_s:.1f} s"
        reason = html.escape("; ".join(map(meaning, why)) or "not initialized")
        rows.append(f"<tr><td>{when}</td><td>{_frames(end - begin)}</td><td>{reason}</td></tr>")
    if len(intervals) > MAX_INTERVALS:
        left = int(sum(end - begin for begin, end in intervals[MAX_INTERVALS:]))
        rest = f"{len(intervals) - MAX_INTERVALS} more intervals, see frames.csv"
        rows.append(f"<tr><td>later</td><td>{_frames(left)}</td><td>{rest}</td></tr>")
    return "".join(rows) or "<tr><td>none</td></tr>"


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def latency_rows(drive: DriveTable) -> str:
    """Returns a table row per stage, with a bar up to p50 (dark) and p99 (light) relative to the largest p99."""
    stages, age = drive.summary["stages_ms"], drive.summary.get("age_ms") or {}
    rows = {str(name): one for name, one in stages.items() if isinstance(one, dict)} | {"total": age}
    largest = max((float(one.get("p99", 0.0)) for one in rows.values()), default=0.0) or 1.0
    out = []
    for name, one in rows.items():
        p50, p99 = float(one.get("p50", 0.0)), float(one.get("p99", 0.0))
        bar = f'<i style="width:{p99 / largest:.1%}"><b style="width:{p50 / (p99 or 1.0):.1%}"></b></i>'
        words = f"p50 {p50:.1f}, p99 {p99:.1f} ms"
        out.append(f'<tr><td>{html.escape(name)}</td><td>{words}</td><td class="bar">{bar}</td></tr>')
    return "".join(out)


def earth_words(drive: DriveTable, earth: EarthTable) -> str:
    """Returns start and end positions and the fit of the GNSS fixes."""
    (lat, lon), (to_lat, to_lon) = earth.degrees[0], earth.degrees[-1]
    entry = drive.summary.get("earth", {})
    fit_of = entry if isinstance(entry, dict) else {}
    fit = (
        f"; {fit_of['fixes']} fixes, {fit_of['outliers']} outliers, RMS {fit_of['rms_m']} m"
        if "rms_m" in fit_of
        else ""
    )
    return f"<p>from {lat:.6f}, {lon:.6f} to {to_lat:.6f}, {to_lon:.6f} (WGS 84){html.escape(fit)}</p>"


def downloads(drive: DriveTable) -> str:
    """Returns links to the files of the drive, which the page contains."""
    out = []
    for name, text in drive.files.items():
        data = base64.b64encode(text.encode()).decode("ascii")
        out.append(f'<a download="{name}" href="data:text/plain;base64,{data}">{name}</a> {FILES[name]}')
    return "<br>".join(out)


def details(drive: DriveTable) -> str:
    """Returns the camera, the networks and the versions."""
    versions, models = drive.summary.get("versions", {}), drive.summary.get("models", {})
    rows = {**(versions if isinstance(versions, dict) else {})}
    for role, model in (models if isinstance(models, dict) else {}).items():
        rows[f"network, {role}"] = model.get("file", "") if isinstance(model, dict) else ""
    cells = "".join(
        f"<tr><td>{html.escape(str(name))}</td><td>{html.escape(str(value))}</td></tr>" for name, value in rows.items()
    )
    camera = f"<pre>{html.escape(drive.camera)}</pre>" if drive.camera else ""
    return f"{camera}<table>{cells}</table>"
