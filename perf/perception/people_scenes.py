"""Rendered people: a child that steps out between parked cars, a crowd at 33 Hz, people who stand beside a driven road.

    python -m perf people_scenes [child crowd standing] [--people 25] [--rate 33] [--light day|evening|rain|night]
                                  [--noise 1] [--output F.json]

The whole method on rendered images, with boxes of the truth's outlines and a detector's noise. The child: seconds from
its first pixel to a valid record, and whether the hidden fans held it. Others: errors, tracks within 2 m and by whose
boxes they took (`of_boxes`), ms a frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.path import Path as Outline

from birdslam.bench.tracking.by_class.class_tracks import HALF_AT_M
from birdslam.bench.tracking.localisation import INSIDE_1_SIGMA, INSIDE_2_SIGMA
from birdslam.bench.tracking.metrics import BoxFrame, assign, hota_parts, identities
from birdslam.geometry.arrays import Floats
from birdslam.perception.external import external_detections
from birdslam.perception.schedule import Networks
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger, spread, spread_text
from birdslam.slam import BirdSLAM
from birdslam.types import PEOPLE, Estimate, Frame, RoadUser

if TYPE_CHECKING:
    from birdslam.world.scenario import Scenario
    from birdslam.world.truth import WorldFrame, WorldObject

label = "rendered people: a child that steps out, a crowd, standing people before a driving ego"

SECONDS = {"child": 3.6, "crowd": 5.0, "standing": 4.0}
NEAR_M = 2.0  # of the true place
SEEN_SHARE = 0.3  # of a body; who is hidden more is not asked for
WALKING_MPS, STANDING_MPS = 0.5, 0.1
SETTLED_S = 1.0  # of a track; what is reported before it is counted apart


def run(arguments: list[str]) -> None:
    """Prints a line for each scene, and writes them."""
    parser = benchmark_parser("people_scenes", label)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SECONDS))
    parser.add_argument("--people", type=int, default=25, help="of the crowd")
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--light", choices=("day", "evening", "rain", "night"), default="day")
    parser.add_argument("--noise", type=float, default=1.0, help="of the boxes' edges, of a detector's")
    options = parser.parse_args(arguments)
    unknown = set(options.scenes) - set(SECONDS)
    if unknown:
        raise PerfError(f"there is no scene {', '.join(sorted(unknown))}; there are {', '.join(SECONDS)}")
    try:
        from birdslam.world import people_scenes
    except ImportError as error:
        raise PerfError(f"rendering needs the extra `train` (pip install 'birdslam[train]'): {error}") from None
    made: dict[str, Callable[[], Scenario]] = {
        "child": people_scenes.child_steps_out,
        "crowd": lambda: people_scenes.crowd(options.people),
        "standing": people_scenes.people_stand,
    }
    settings = {name: getattr(options, name) for name in ("people", "rate", "light", "noise")}
    with Ledger(options.output, label, **settings) as ledger:
        for name in options.scenes or SECONDS:
            scene = people_scenes.lit(made[name](), options.light)
            steps = list(driven(scene, round(SECONDS[name] * options.rate), options.rate, noise=options.noise))
            row = of_child(steps, options.rate) if name == "child" else of_many(steps, options.rate)
            ledger.add(name, "  ".join(f"{key} {value}" for key, value in row.items()), **row)


@dataclass(frozen=True)
class Step:
    """One frame: what is true, what is reported, and what it took."""

    truth: WorldFrame
    estimate: Estimate
    people_ms: float
    graph_ms: float
    taken: dict[int, int | None]  # of the bodies that have a box, who is reported to be it


def driven(scenario: Scenario, count: int, rate_hz: float, samples: int = 1, noise: float = 1.0) -> Iterator[Step]:
    """The method over `count` rendered frames, with boxes made of the truth."""
    from birdslam.world.people_scenes import CAMERA, boxes
    from birdslam.world.scenario import drive

    slam, rng = BirdSLAM(CAMERA, Networks((), _no_head)), np.random.default_rng(0)
    people, took = slam.frontend.people, dict[str, float]()
    people.settle = _timed(people.settle, took, "people")  # type: ignore[method-assign]
    slam.graph.optimise = _timed(slam.graph.optimise, took, "graph")  # type: ignore[method-assign]
    for truth in drive(scenario, CAMERA, count, rate_hz, samples):
        t_ns = truth.t_source_ns
        found, labels, scores, bodies = boxes(truth, rng, noise)
        frame = Frame(frame_id=truth.frame_id, t_source_ns=t_ns, t_capture_ns=t_ns, t_utc_ns=t_ns, image=truth.image)
        _, estimate, placed = slam.step(frame, external_detections(found, labels, scores, detector="configured"))
        taken = {body: None if box is None else box.track for body, box in zip(bodies, placed, strict=True)}
        yield Step(truth, estimate, took["people"], took["graph"], taken)


def _no_head(*_: Any) -> Any:
    raise AssertionError("no network runs here")


def _timed(function: Callable[..., Any], took: dict[str, float], name: str) -> Callable[..., Any]:
    def timed(*arguments: Any) -> Any:
        begun_s = time.perf_counter()
        result = function(*arguments)
        took[name] = 1e3 * (time.perf_counter() - begun_s)
        return result

    return timed


def place_of(estimate: Estimate, user: RoadUser) -> tuple[Floats, Floats]:
    """(2,) place and velocity in the ego's axes."""
    at = estimate.T_world_ego.between(user.T_world_vehicle)
    return np.array([at.x_m, at.y_m]), np.asarray(user.velocity_mps) @ estimate.T_world_ego.rotation()


def true_place(truth: WorldFrame, body: WorldObject) -> tuple[Floats, Floats]:
    """The same of a body."""
    ahead = truth.T_world_cam[:2, 2] / np.linalg.norm(truth.T_world_cam[:2, 2])
    R = np.array([[ahead[0], -ahead[1]], [ahead[1], ahead[0]]])
    return np.array([body.T_ego_object.x_m, body.T_ego_object.y_m]), body.velocity_mps @ R


def in_a_fan(estimate: Estimate, at_m: Floats) -> bool:
    """Whether the road there is reported to be hidden."""
    return any(Outline(fan.corners_m).contains_points(at_m[None])[0] for fan in estimate.hidden)


def of_child(steps: list[Step], rate_hz: float) -> dict[str, Any]:
    """From the first pixel of the only pedestrian to the first valid record that holds it within 2 sigma."""
    first = recorded = near = None
    held, rel, off_mps, sure = list[bool](), list[float](), list[float](), list[bool]()
    for k, step in enumerate(steps):
        child = next((body for body in step.truth.objects if body.label in PEOPLE), None)
        if child is None:
            continue
        at, velocity = true_place(step.truth, child)
        if first is None and child.pixels == 0:
            held.append(in_a_fan(step.estimate, at))
            continue
        first = k if first is None else first
        seen = [user for user in step.estimate.people if user.seen] if step.estimate.valid else []
        if not seen:
            continue
        errors = [place_of(step.estimate, user)[0] - at for user in seen]
        nearest = int(np.argmin(np.linalg.norm(errors, axis=1)))
        inside = mahalanobis2(step.estimate, seen[nearest], errors[nearest]) <= INSIDE_2_SIGMA
        sure.append(inside)
        recorded = k if recorded is None and inside else recorded
        near = k if near is None and np.linalg.norm(errors[nearest]) < NEAR_M else near
        rel.append(abs(float(errors[nearest][0])) / float(at[0]))
        off_mps.append(float(np.linalg.norm(place_of(step.estimate, seen[nearest])[1] - velocity)))
    if first is None:
        raise PerfError("the child was never seen")
    last_second = held[-round(rate_hz) :]
    at, _ = true_place(steps[first].truth, next(b for b in steps[first].truth.objects if b.label in PEOPLE))
    return {
        "first_pixel_ahead_m": round(float(at[0]), 1),
        "record_after_s": None if recorded is None else round((recorded - first) / rate_hz, 3),
        "within_2_m_after_s": None if near is None else round((near - first) / rate_hz, 3),
        "in_hidden_fan_second_before": round(float(np.mean(last_second)), 2) if last_second else None,
        "inside_2_sigma": round(float(np.mean(sure)), 2) if sure else None,
        "depth_error_median_rel": _median(rel),
        "velocity_error_median_mps": _median(off_mps),
    }


def mahalanobis2(estimate: Estimate, user: RoadUser, error_m: Floats) -> float:
    """The square of an error in the ego's axes over the covariance that is reported."""
    own = user.T_world_vehicle.rotation().T @ estimate.T_world_ego.rotation() @ error_m
    return float(own @ np.linalg.solve(np.reshape(user.cov, (3, 3))[:2, :2], own))


def of_many(steps: list[Step], rate_hz: float) -> dict[str, Any]:
    """Places, speeds, tracks and milliseconds of many people."""
    depth, inside, walking, standing, frames = list[float](), list[float](), list[float](), list[float](), []
    for step in steps:
        bodies = [b for b in step.truth.objects if b.label in PEOPLE and b.visible >= SEEN_SHARE]
        users = [user for user in step.estimate.people if user.in_sight]
        true = [true_place(step.truth, body) for body in bodies]
        estimated = [place_of(step.estimate, user) for user in users]
        away = np.linalg.norm(
            np.reshape([at for at, _ in true], (-1, 1, 2)) - np.reshape([at for at, _ in estimated], (1, -1, 2)),
            axis=-1,
        )
        likeness = np.maximum(0.0, 1.0 - away / (2.0 * HALF_AT_M))
        frames.append(
            BoxFrame(np.array([b.object_id for b in bodies], np.int64), np.array([u.vehicle for u in users], np.int64),
                     likeness)
        )  # fmt: skip
        for i, j in zip(*assign(likeness), strict=True):
            (at, velocity), (estimated_at, estimated_mps) = true[i], estimated[j]
            if not 5.0 <= at[0] < 30.0 or users[j].frames < SETTLED_S * rate_hz:
                continue
            error = estimated_at - at
            depth.append(abs(float(error[0])) / float(at[0]))
            inside.append(mahalanobis2(step.estimate, users[j], error))
            speed = float(np.linalg.norm(velocity))
            if speed > WALKING_MPS:
                walking.append(float(np.linalg.norm(estimated_mps - velocity)))
            elif speed < STANDING_MPS:
                standing.append(float(np.linalg.norm(estimated_mps)))
    parts, kept, of_boxes = hota_parts(frames), identities(frames), [_of_boxes(step) for step in steps]
    sure = np.array(inside)
    return {
        "followed_most": max(len(step.estimate.people) for step in steps),
        "valid": round(float(np.mean([step.estimate.valid for step in steps])), 3),
        "n": len(depth),
        "depth_error_median_rel": _median(depth),
        "inside_1_sigma": round(float(np.mean(sure <= INSIDE_1_SIGMA)), 2) if len(sure) else None,
        "inside_2_sigma": round(float(np.mean(sure <= INSIDE_2_SIGMA)), 2) if len(sure) else None,
        "walking_error_median_mps": _median(walking),
        "standing_told_median_mps": _median(standing),
        **({} if parts is None else {name: round(getattr(parts, name), 3) for name in ("hota", "det_a", "ass_a")}),
        "idf1": round(kept.idf1, 3),
        "switches_per_minute": round(kept.switches * 60.0 * rate_hz / len(steps), 1),
        "idf1_of_boxes": round(identities(of_boxes).idf1, 3),
        "switches_per_minute_of_boxes": round(identities(of_boxes).switches * 60.0 * rate_hz / len(steps), 1),
        "people_ms": spread_text(spread([step.people_ms for step in steps]), "ms"),
        "graph_ms": spread_text(spread([step.graph_ms for step in steps]), "ms"),
    }


def _of_boxes(step: Step) -> BoxFrame:
    """The people who have a box, and who took it: places do not change that."""
    people = {body.object_id for body in step.truth.objects if body.label in PEOPLE}
    asked = {body: track for body, track in step.taken.items() if body in people}
    tracks = sorted({track for track in asked.values() if track is not None})
    overlap = np.array([[float(track == taken) for track in tracks] for taken in asked.values()])
    return BoxFrame(
        np.array(list(asked), np.int64), np.array(tracks, np.int64), overlap.reshape(len(asked), len(tracks))
    )


def _median(values: list[float]) -> float | None:
    return round(float(np.median(values)), 3) if values and math.isfinite(sum(values)) else None
