"""The paper's ablations as variants of the incremental method (its Tables 3 and 4) and of the batch (Table 5).

A variant is a change of weights, so that it runs on the same log. "Without" is a weight of as good as zero (1e-3,
against the paper's 1 to 10000): CC keeps its motion as the guess that the graph starts from, CV the first sight of a
vehicle, as nothing else says where they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import msgspec

from birdslam.bench.baselines import batch_se3
from birdslam.bench.baselines.trajectories import Method, Trajectories
from birdslam.bench.tracking.benchmark import PAPER, Final, Live
from birdslam.geometry.camera import Camera
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import NO_WEIGHT, EdgeType, WeightsConfig
from birdslam.road_users.rts_smoother import SmootherConfig
from birdslam.types import Measurements

CP_WEIGHTS = MappingProxyType({"cp_low": 0.01, "cp_medium": 1.0, "cp_high": 100.0})  # against CC's own
DEPTHS_M = MappingProxyType(
    {"depth_12": 12.0, "depth_15": 15.0, "depth_18": 18.0, "depth_20": 20.0, "depth_none": None}
)
MAX_LANDMARK_DISTANCE_M = 200.0  # beyond any threshold, so that the front end's own limit does not hide it


def constraint_variants(base: Live) -> dict[str, Live]:
    """Table 3: without one type of edge each, and with all."""
    return {
        "without_cc": _leave_out(base, "cc"),
        "without_cv": _without_cv(base),
        "without_vv": _without_vv(base),
        "without_cp": _leave_out(base, "cp"),
        "all": base,
    }


def landmark_variants(base: Live) -> dict[str, Live]:
    """Table 4: the weight of CP against CC's, and the depth from which on landmarks are left out."""
    out = {}
    for name, factor in CP_WEIGHTS.items():
        if base.weights.mode == "paper":
            weight = factor * base.weights.cc
            out[name] = _reweighted(base, cp=weight, cp_vehicles=base.weights.cp_vehicles and weight)
        else:
            out[name] = replace(base, cp_inflation=1.0 / factor)
    for name, depth_m in DEPTHS_M.items():
        out[name] = _reweighted(base, depth_threshold_m=depth_m)
    return out


def idea_variants() -> dict[str, Method]:
    """Returns ideas of our back end, each alone added to the paper's method, for a log of the paper's placing."""
    default = GraphConfig()
    gates = {name: getattr(default, name) for name in ("detection_gate_sigma", "landmark_gate_sigma")}
    return {
        "nothing (the paper)": PAPER,
        "gates on outliers": replace(PAPER, graph=msgspec.structs.replace(PAPER.graph, **gates)),
        "measured covariances": replace(PAPER, weights=WeightsConfig(leave_out=())),
        "the smoother": Final(PAPER, SmootherConfig()),
    }


def placed_variants(base: Live) -> dict[str, Method]:
    """The same for a log of our placing: that alone, and everything together, live and final."""
    return {
        "vehicles placed by measured ground and size": PAPER,
        "all, live": base,
        "all, final": Final(base, SmootherConfig()),
    }


def lane_variants() -> dict[str, Method]:
    """Table 5: the batch before and after lane constraints."""
    return {"before_lanes": _BatchWithoutLanes(), "after_lanes": batch_se3}


def depth_of(method: Method) -> float:
    """How far away (m) the landmarks are that a method takes."""
    depth_m = method.weights.depth_threshold_m if isinstance(method, Live) else 0.0
    return math.inf if depth_m is None else depth_m


@dataclass(frozen=True)
class _BatchWithoutLanes:
    def run(self, log: Sequence[Measurements], camera: Camera) -> Trajectories:
        return batch_se3.run(log, camera, lanes=False)


def _leave_out(base: Live, edge: EdgeType) -> Live:
    return _reweighted(base, leave_out=tuple({*base.weights.left_out, edge}))


def _without_vv(base: Live) -> Live:
    """Neither VV edges nor what stands in for them in our graph."""
    base = _leave_out(base, "vv")
    return replace(base, graph=msgspec.structs.replace(base.graph, constant_velocity=False))


def _without_cv(base: Live) -> Live:
    """Nor CP edges of vehicles, which repeat what the CV edges measured."""
    if base.weights.mode == "paper":
        return _reweighted(base, cv_near=NO_WEIGHT, cv_far=NO_WEIGHT, cp_vehicles=None)
    graph = msgspec.structs.replace(base.graph, lasting_share=0.0)  # of an edge without weight nothing lasts
    return replace(base, cv_inflation=1.0 / NO_WEIGHT, graph=graph)


def _reweighted(base: Live, **weights: object) -> Live:
    return replace(base, weights=msgspec.structs.replace(base.weights, **weights))
