"""Answers planners' queries in the supervisor: the whole map, all trajectories so far, the configuration.

It survives restarts of the nodes. A reply is split into parts that each fit into a message.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from birdslam.lanes.amodal.atlas import Atlas
from birdslam.queries import MapSnapshot, Nearby, Trajectory, nearby
from birdslam.runtime.configuration import Configuration, without_passwords
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.transport.queries import QueryRefused, positive
from birdslam.runtime.transport.reply_parts import map_parts, trajectory_parts
from birdslam.types import Estimate, MapUpdate


class QueryServer:
    """Stores the output of the optimizer and answers queries about it until its bus is closed."""

    def __init__(self, configuration: Configuration, bus: Bus) -> None:
        self._configuration = configuration
        self._atlas = Atlas(configuration.atlas)
        self._newest: Estimate | None = None
        self._turn = threading.Lock()  # one thread adds, another answers
        bus.answer_queries(
            {"map": self._map, "trajectory": self._trajectory, "nearby": self._nearby, "configuration": self._settings}
        )

    def add(self, estimate: Estimate) -> None:
        """Adds the estimate of a frame."""
        with self._turn:
            self._atlas.add(estimate)
            self._newest = estimate

    def add_map(self, update: MapUpdate) -> None:
        """Adds the map update of a frame, after its estimate."""
        with self._turn:
            if self._newest is not None:
                self._atlas.add(self._newest, update)

    def _map(self, parameters: Mapping[str, str]) -> Sequence[MapSnapshot]:
        with self._turn:
            snapshot = self._atlas.map()
        if snapshot is None:
            raise QueryRefused("there is no map yet: nothing has been estimated")
        return map_parts(snapshot)

    def _trajectory(self, parameters: Mapping[str, str]) -> Sequence[Trajectory]:
        last_s = positive(parameters, "last_s")
        with self._turn:
            trajectory = self._atlas.trajectory(last_s)
        if trajectory is None:
            raise QueryRefused("there is no trajectory yet: nothing has been estimated")
        return trajectory_parts(trajectory)

    def _nearby(self, parameters: Mapping[str, str]) -> Sequence[Nearby]:
        with self._turn:
            newest = self._newest
        if newest is None:
            raise QueryRefused("there are no road users yet: nothing has been estimated")
        return (nearby(newest),)

    def _settings(self, parameters: Mapping[str, str]) -> Sequence[Configuration]:
        """Without the passwords in camera addresses."""
        return (without_passwords(self._configuration),)
