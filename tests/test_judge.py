"""The judge of the fault suite: an undisturbed drive passes, a wrong pose does not."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Perception, Ready
from birdslam.perf.accuracy import street
from birdslam.perf.robustness.faulty_vehicle import RATE_HZ
from birdslam.perf.robustness.judge import Judge
from birdslam.types import Estimate, Frame

FRAMES, SETTLED = 60, 4


@pytest.fixture(scope="module")
def loop() -> NDArray[np.uint8]:
    return street.street_loop()


@pytest.fixture(scope="module")
def drive(loop: NDArray[np.uint8]) -> list[Estimate]:
    """Without networks and without a fault."""
    size = {"width_px": street.WIDTH_PX, "height_px": street.HEIGHT_PX}
    centre = {"cx_px": street.WIDTH_PX / 2, "cy_px": street.HEIGHT_PX / 2}
    camera = Camera(**size, **centre, fx_px=street.F_PX, fy_px=street.F_PX, height_m=street.HEIGHT_M)
    frontend, graph = FrontEnd(camera, FrontEndConfig()), PoseGraph(GraphConfig(), WeightsConfig())
    estimates = []
    for number in range(FRAMES):
        t_ns = round((number + 0.5) * 1e9 / RATE_HZ)
        frame = Frame(number, t_ns, t_ns, 0, loop[number])
        estimates.append(graph.optimise(frontend.measure(frame, Ready(Perception()))))
    return estimates


def judged(estimates: list[Estimate]) -> Judge:
    judge = Judge(lambda t_ns: math.floor(t_ns * 1e-9 * RATE_HZ) * street.FRAME_M, street.FRAME_M)
    for estimate in estimates:
        judge.see(estimate)
    return judge


def test_each_pixel_of_the_street_is_the_mean_of_what_it_covers() -> None:
    texture = street.texture(5)
    y, x = np.linspace(-700.25, 3000.5, 301), np.linspace(17.3, 2100.1, 201)  # over several turns, off the grid
    parts = texture.mean(y[:-1], y[1:], x[:-1], x[1:])
    whole = texture.mean(*(np.array([edge]) for edge in (y[0], y[-1], x[0], x[-1])))
    assert whole[0, 0] == pytest.approx(parts.mean(), abs=1e-6)
    assert parts.std() > 10.0
    rows, column = (np.arange(9.0), np.arange(1.0, 10.0)), (np.array([5.0]), np.array([6.0]))
    turned = (edge - street.TEXELS for edge in rows)
    assert texture.mean(*turned, *column) == pytest.approx(texture.mean(*rows, *column), abs=1e-6)


def test_the_end_of_the_street_meets_its_beginning(loop: NDArray[np.uint8]) -> None:
    steps = np.abs(np.diff(np.concatenate([loop, loop[:1]]).astype(np.int16), axis=0)).mean(axis=(1, 2))
    assert steps[-1] == pytest.approx(steps[:-1].mean(), rel=0.1)


def test_an_undisturbed_drive_is_valid_and_right(drive: list[Estimate]) -> None:
    assert all(estimate.valid for estimate in drive[SETTLED:])
    assert judged(drive).wrong == 0


def test_pose_jump_without_new_epoch_is_wrong(drive: list[Estimate]) -> None:
    """At the end of the drive: marked valid, with a large covariance, marked invalid."""
    driven_m = (FRAMES - SETTLED) * street.FRAME_M
    jump = SE2(0.3 * driven_m + 5.0, 0.0, 0.0)
    last = msgspec.structs.replace(drive[-1], T_world_ego=drive[-1].T_world_ego @ jump)
    unsure = msgspec.structs.replace(last, cov=tuple(np.diag([jump.x_m**2, jump.x_m**2, 0.1]).ravel().tolist()))
    assert judged([*drive[:-1], last]).wrong == 1
    assert judged([*drive[:-1], unsure]).wrong == 0
    assert judged([*drive[:-1], msgspec.structs.replace(last, valid=False)]).wrong == 0


def test_a_pose_that_turns_is_wrong(drive: list[Estimate]) -> None:
    turned = msgspec.structs.replace(drive[-1], T_world_ego=drive[-1].T_world_ego @ SE2(0.0, 0.0, 0.5))
    assert judged([*drive[:-1], turned]).wrong == 1
