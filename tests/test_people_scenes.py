"""Rendered people: who hides is held by the hidden fans, and the planner of docs/examples stops for who steps out."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the built-in world is rendered with numba (extra `train`)")

from birdslam.perf.perception.people_scenes import Step, driven, in_a_fan, of_child, true_place
from birdslam.types import PEOPLE
from birdslam.world.people_scenes import CAMERA, child_steps_out, crowd, lit
from birdslam.world.rendering import materials as m
from birdslam.world.scenario import drive
from birdslam.world.traffic.flow import advance

RATE_HZ, COUNT = 20.0, 60
EGO_MPS, BRAKING_MPS2, REACTION_S = 8.0, 5.0, 0.2
STOP = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "examples" / "stop_for_people.py"))["who_stops_us"]


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return list(driven(child_steps_out(EGO_MPS), COUNT, RATE_HZ))


@pytest.mark.slow
def test_a_child_that_steps_out_was_held_by_the_hidden_fans_and_is_told_at_once(steps: list[Step]) -> None:
    figures = of_child(steps, RATE_HZ)
    assert figures["in_hidden_fan_second_before"] > 0.9
    assert figures["record_after_s"] < 0.5
    assert figures["inside_2_sigma"] > 0.9


@pytest.mark.slow
def test_the_planner_of_the_examples_stops_before_the_child_and_not_before_it_is_seen(steps: list[Step]) -> None:
    stops = [bool(STOP(step.estimate)) for step in steps]
    first = stops.index(True)
    (child,) = [body for body in steps[first].truth.objects if body.label in PEOPLE]
    assert child.pixels > 0
    ahead_m = true_place(steps[first].truth, child)[0][0]
    assert ahead_m > EGO_MPS * REACTION_S + EGO_MPS**2 / (2.0 * BRAKING_MPS2)
    after = [stop for step, stop in zip(steps[first:], stops[first:], strict=True) if _ahead(step)]
    assert np.mean(after) > 0.9


def _ahead(step: Step) -> bool:
    return any(b.label in PEOPLE and b.T_ego_object.x_m > 3.0 and b.visible > 0.5 for b in step.truth.objects)


@pytest.mark.slow
def test_nobody_is_in_a_fan_where_the_road_is_free(steps: list[Step]) -> None:
    assert not any(in_a_fan(step.estimate, np.array([x_m, 1.0])) for step in steps for x_m in (4.0, 8.0))


@pytest.mark.slow
@pytest.mark.parametrize("light", ["day", "rain", "night"])
def test_some_push_prams_in_every_light(light: str) -> None:
    """Who goes across with a pram is a wider outline."""
    assert [k for k, mover in enumerate(crowd(5).movers) if mover.body.parameters[m.GLOSS] > 0.5] == [4]
    widths = []
    for pushes in (1.0, 0.0):
        scene = lit(crowd(5), light)
        walker = scene.movers[4]
        walker.turn_rad, walker.walks, walker.body.parameters[m.GLOSS] = np.pi / 2, [], pushes
        (frame,) = drive(scene, CAMERA, 1, RATE_HZ, 1)
        widths.append(np.ptp(np.nonzero(frame.instances == 5)[1]))
    assert widths[0] > 1.5 * widths[1]


def test_people_wait_set_out_and_turn_back_at_their_times() -> None:
    scenario = crowd(8)
    waits = scenario.movers[0]
    (from_s, turn_rad, speed_mps), (back_s, *_), *_ = waits.walks
    street, at, movers = scenario.street, (waits.s_m, waits.d_m), list(scenario.movers)
    t_s, dt_s = 0.0, 0.05
    while t_s < from_s:
        assert (waits.s_m, waits.d_m) == at
        advance(movers, scenario.ego, street, t_s, dt_s)
        t_s += dt_s
    while t_s < back_s:
        advance(movers, scenario.ego, street, t_s, dt_s)
        t_s += dt_s
    went = np.array([waits.s_m - at[0], waits.d_m - at[1]])
    assert went @ [np.cos(turn_rad), np.sin(turn_rad)] == pytest.approx(speed_mps * (back_s - from_s), abs=0.2)
    advance(movers, scenario.ego, street, t_s, dt_s)
    assert waits.turn_rad == pytest.approx(turn_rad + np.pi)
