"""A foreign zenoh session on the bus of a vehicle, without the checks of the bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh

from birdslam.runtime.transport.presence import runtime_dir_of, socket_path
from birdslam.runtime.transport.session import session_config


@contextmanager
def foreign_session(
    base: Path, vehicle: str = "car", as_hub: bool = False, patient: bool = False
) -> Iterator[zenoh.Session]:
    """A session that only connects to the hub, as a planner's does; or the one that all connect to.

    `patient`: no silence on a busy machine closes its links to those that are `lossless`.
    """
    hub = [socket_path(runtime_dir_of(vehicle, base), "hub")]
    with zenoh.open(session_config(hub if as_hub else [], [] if as_hub else hub, patient)) as session:
        yield session


def matched(publisher: zenoh.Publisher) -> bool:
    """Whether somebody subscribes to what it sends; before that, all is lost."""
    status: zenoh.MatchingStatus = publisher.matching_status
    return status.matching
