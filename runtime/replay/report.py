"""Prints the outcome of a replay."""

from __future__ import annotations

import importlib.metadata

from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.replay.verdict import Verdict

MAX_FIELDS = 12


def report(verdict: Verdict, recording: Recording) -> str:
    """Returns the verdict as text; after a difference also the libraries of other versions."""
    lines = [
        f"equal bit for bit: {verdict.equal} estimates ({verdict.coasted} of them coasted), {verdict.maps} map updates",
        f"epochs: {verdict.epochs}, restarts of the optimizer: {verdict.restarts}",
    ]
    if verdict.unanswered:
        lines.append(f"measurements without an estimate: {verdict.unanswered}")
    if verdict.unknown:
        lines.append(f"not compared, since their measurements were not recorded: {verdict.unknown} estimates")
    if not recording.complete:
        lines.append(f"the recording was cut off: {verdict.open_end} records at its end lack their counterpart")
    if recording.damaged:
        lines.append(f"damaged chunks skipped: {recording.damaged}")
    difference = verdict.difference
    if difference is not None:
        lines.append(f"first difference: frame {difference.frame_id} DIFFERS:")
        shown = difference.fields[:MAX_FIELDS]
        lines += [f"  {where}: recorded {recorded}, replayed {replayed}" for where, recorded, replayed in shown]
        if len(difference.fields) > MAX_FIELDS:
            lines.append(f"  and {len(difference.fields) - MAX_FIELDS} more")
        for name, version in recording.about.versions.items():
            now = _version(name)
            if now is not None and now != version:
                lines.append(f"  recorded with {name} {version}, here it is {now}")
    elif not verdict.equal:
        lines.append("nothing could be compared")
    return "\n".join(lines)


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None
