"""The map process of a run: its station and its entries of the summary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.maps.map_process import SUMMARY
from birdslam.runtime.process.beside import DISK_STATUS
from birdslam.runtime.supervision.stations import Duty, Station
from birdslam.runtime.topology import MAP

WATCHDOG_S = 30.0  # closing a loop in a long map takes seconds


def map_station(configuration: Configuration, logs: Path) -> Station:
    """Starts the map process. The run continues without it."""
    (logs / SUMMARY).unlink(missing_ok=True)
    duty = Duty(
        module="birdslam.runtime.maps.map_process",
        final_statuses=(USER_ERROR_STATUS, DISK_STATUS),
        without="the drive is no longer localised in its map",
        watchdog_s=WATCHDOG_S,
    )
    return Station(MAP.name, configuration, logs, duty)


def map_summary(station: Station, logs: Path) -> dict[str, Any]:
    """Returns "map" and "earth" of summary.json after the process has ended."""
    try:
        found: dict[str, Any] = msgspec.json.decode((logs / SUMMARY).read_bytes(), type=dict[str, Any])
    except (OSError, msgspec.DecodeError):
        found = {"map": {"error": f"the map process {station.process.how()}; its last saved map is kept"}}
    found["map"]["restarts"] = station.restarts.count
    return found
