"""The amodal lanes of a log as landmarks: what Table 5 of the paper calls lane constraints.

The front end's own CP edges of lanes are of what single frames saw (mapping/lane_edges.py). The paper ties the ego to
"a dense point-cloud for the road plane segregated for each lane", which are its completed lanes: `Measurements.lanes`
with an id. They are of many frames, put together with the odometry that they are to correct, so that they have little
to say against it; live they are left out, since what was measured of lanes there moves nothing (docs/ablations.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from birdslam.bench.baselines.trajectories import dead_reckoned
from birdslam.lanes.amodal.lane_edges import LaneEdgesConfig, Station, fit_stations
from birdslam.types import LandmarkKind, Measurements

# Points of the completed lanes are thinned to one a cell, a few on a station's stretch
CONFIG = LaneEdgesConfig(least_points=4)


def with_completed_lanes(log: Sequence[Measurements]) -> list[Measurements]:
    """The log with CP edges to stations of its completed lanes in place of those of lanes that single frames saw.

    A station is known across its lane, by the width of a marking, and as good as unknown along it.
    """
    ego = dead_reckoned(log).ego
    out = []
    for m in log:
        cp = [edge for edge in m.cp if edge.kind is not LandmarkKind.LANE_STATION]
        known = [point for point in m.lanes if point.lane >= 0]
        if known:
            T_world_ego = ego[m.frame_id]
            points_m = T_world_ego @ np.array([[point.x_m, point.y_m] for point in known])
            for landmark, point_m, along in fit_stations(points_m, np.array([point.lane for point in known]), CONFIG):
                across = np.array([-along[1], along[0]])
                cov = np.outer(across, across) * CONFIG.sigma_across_m**2
                cov += np.outer(along, along) * CONFIG.sigma_along_m**2
                cp.append(Station(landmark, point_m, cov).edge(m.frame_id, T_world_ego))
        out.append(replace(m, cp=tuple(cp)))
    return out


def of_kind(log: Sequence[Measurements], kind: LandmarkKind) -> list[Measurements]:
    """The log with CP edges of this kind alone."""
    return [replace(m, cp=tuple(edge for edge in m.cp if edge.kind is kind)) for m in log]
