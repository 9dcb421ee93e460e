"""The report at the end of a run: summary.json and the printed table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from birdslam.runtime.configuration import Configuration, dump
from birdslam.runtime.environment import library_versions
from birdslam.runtime.supervision.demo_report import rows as truth_rows
from birdslam.runtime.supervision.final_results import rows as final_rows
from birdslam.runtime.supervision.logbook import Logbook
from birdslam.runtime.supervision.stations import Station
from birdslam.runtime.topology import NODES


def summarise(
    configuration: Configuration, stations: Mapping[str, Station], logbook: Logbook, models: dict[str, Any], ended: str
) -> dict[str, Any]:
    """Returns the content of summary.json, without the recorder's counts."""
    sent = {name: stations[name].total("frames") for name in NODES}
    by = {
        "capture": stations["capture"].total("dropped"),
        "perceive": sent["capture"] - sent["perceive"],
        "optimize": sent["perceive"] - sent["optimize"],
        "supervisor": sent["optimize"] - logbook.recorded,
    }
    return {
        "ended": ended,
        "source": configuration.source.uri,
        "frames_in": sent["capture"] + by["capture"],
        "frames_processed": logbook.recorded,
        "frames_predicted": logbook.predicted,  # of those, predicted by perceive for lack of time
        "frames_dropped": sum(by.values()),
        "dropped_by": by,
        "looks": stations["perceive"].total("looks"),  # frames on which a network ran
        "torn": stations["perceive"].total("torn"),
        "malformed": sum(station.total("malformed") for station in stations.values()),
        "car_speeds": {
            "taken": stations["capture"].total("speeds"),
            "dropped": stations["capture"].total("speeds_dropped"),
        },
        "restarts": {name: station.restarts.count for name, station in stations.items()},
        **logbook.figures(),
        "budget": _budget(configuration, logbook),
        "models": models,
        "configuration": dump(configuration),
        "versions": library_versions(),
    }


def _budget(configuration: Configuration, logbook: Logbook) -> dict[str, Any]:
    """Returns the age of the estimates and whether it is within the end-to-end budget."""
    budgets = configuration.budgets
    age_ms = logbook.age.percentile(budgets.percentile)
    return {
        "percentile": budgets.percentile,
        "end_to_end_ms": budgets.end_to_end_ms,
        "age_ms": round(age_ms, 3) if logbook.age.count else None,
        "kept": bool(logbook.age.count) and age_ms <= budgets.end_to_end_ms,
    }


def table(summary: dict[str, Any], output: Path) -> str:
    """Returns the figures of a run as a printable table."""

    def spread(figures: dict[str, float]) -> str:
        if not figures:
            return "-"
        return f"p50 {figures['p50']:.1f}  p99 {figures['p99']:.1f}  max {figures['max']:.1f} ms"

    whole = summary["budget"]
    budget = f"p{whole['percentile']:g} within {whole['end_to_end_ms']:g} ms: {'kept' if whole['kept'] else 'NOT KEPT'}"
    dropped = {name: n for name, n in summary["dropped_by"].items() if n}
    by = f" ({', '.join(f'{n} by {name}' for name, n in dropped.items())})" if dropped else ""
    unseen = summary["frames_predicted"]
    predicted = f" ({unseen} of them predicted)" if unseen else ""
    paced = (
        ("age at the planner", spread(summary["age_ms"])),
        ("  of its budget", budget),
        *((f"  {name}", spread(figures)) for name, figures in summary["stages_ms"].items()),
    )
    rows = [
        ("ended", summary["ended"]),
        (
            "frames",
            f"{summary['frames_in']} in, {summary['frames_processed']} processed{predicted}, "
            f"{summary['frames_dropped']} dropped{by}",
        ),
        ("rate", f"{summary['rate_hz']:.2f} Hz"),
        ("networks ran on", f"{summary['looks']} frames"),
        *(paced if summary["configuration"]["source"]["rate"] != "max" else ()),  # at rate "max" frames wait in queues
        *((f"  {name} restarted", f"{n} times") for name, n in summary["restarts"].items() if n),
        *((f"  {status}", f"{n} frames") for status, n in summary["statuses"].items()),
        *((f"  metres from {source}", f"{n} frames") for source, n in summary["speed_sources"].items()),
        *(("car's readings", _readings(speeds)) for speeds in [summary["car_speeds"]] if any(speeds.values())),
        *truth_rows(summary),
        *final_rows(summary),
        *(("recorded", _recorded(recording)) for recording in [summary.get("recording")] if recording),
        ("results in", str(output)),
    ]
    return "\n".join(f"{name:24}{value}" for name, value in rows)


def _readings(speeds: dict[str, int]) -> str:
    return f"{speeds['taken']} received from the bus, {speeds['dropped']} lost"


def _recorded(recording: dict[str, Any]) -> str:
    lost = recording["dropped"] + recording["images_torn"]
    state = f", restarted {recording['restarts']} times" if recording["restarts"] else ""
    state += ", CUT OFF" if recording["cut_off"] else ""
    size = f"{recording['messages']} messages, {lost} lost, {recording['bytes'] / 1e6:.1f} MB"
    return f"{', '.join(recording['files'])}: {size}{state}"
