"""What lanes are made of, for a picture (paper, Fig. 4): the cells that were seen, completed, and the lanes of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.mapping.lanes import AmodalLanes, Floats, Grids, segregate


@dataclass(frozen=True)
class LaneView:
    """Around the ego at one pose. Grids (2, rows, columns) of 0..1: road and lane boundary, as in lanes.py."""

    seen: Grids
    completed: Grids  # what was seen, and what the network added; without one the same as `seen`
    lanes_seen: list[Floats]  # clouds (N, 2) in ego, without the network
    lanes: list[Floats]  # with it: the amodal lanes


def lane_view(amodal: AmodalLanes, T_world_ego: SE2) -> LaneView:
    """The steps of `AmodalLanes.lanes`, each kept. Changes nothing: no lane gets an id."""
    seen = amodal.grids(T_world_ego)
    added = seen if amodal.complete is None else amodal.complete(seen)
    completed = np.maximum(seen, added) if np.isfinite(added).all() else seen
    return LaneView(seen, completed, segregate(seen, amodal.config), segregate(completed, amodal.config))
