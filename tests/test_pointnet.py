"""Frustum-PointNet by manifest: its input points, and its outputs transformed to the camera."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.perception import ModelError, ModelSpec
from birdslam.perception.pointnet import frustum_of, load_pointnet
from birdslam.perception.pointnet_manifest import Points
from tests import tiny_networks as tiny

CAMERA = Camera(width_px=640, height_px=192, fx_px=400.0, fy_px=400.0, cx_px=320.0, cy_px=96.0, height_m=1.6)
BODY = """
role = "pointnet"
[points]
name = "points"
count = 64
features = ["x", "y", "z", "u", "v", "log_depth"]
[pointnet]
decoding = "body"
output = "body"
mean_m = [4.0, 2.0, 1.5]
"""
BINS = """
role = "pointnet"
[points]
name = "points"
count = 64
layout = "NPC"
centred = false
class_name = "class"
classes = ["car", "truck"]
[pointnet]
decoding = "bins"
centre = "centre"
heading_scores = "hs"
heading_residuals = "hr"
size_scores = "ss"
size_residuals = "sr"
templates_m = [[4.0, 2.0, 1.5], [10.0, 2.5, 3.0]]
"""


def patch(x_m: float = 3.0, z_m: float = 12.0, n: int = 20) -> NDArray[np.float64]:
    """A square of points facing the camera, in the order of pixels, with a wall far behind its right edge."""
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-0.7, 0.7, n))
    z = np.where(u > 0.8, z_m + 30.0, z_m)
    return np.stack([(x_m + u) / z_m * z, v / z_m * z, z], axis=-1).reshape(-1, 3)


def answering(tmp_path: Path, text: str, answers: dict[str, NDArray], inputs: dict[str, tuple]) -> Path:
    network = tiny.answering(tmp_path / "net.onnx", inputs, answers)
    network.with_suffix(".toml").write_text(text)
    return network


def body(tmp_path: Path, values: list[float], batch: int | str = 1, text: str = BODY) -> Path:
    return answering(tmp_path, text, {"body": np.array([values], np.float32)}, {"points": (batch, 6, 64)})


ANSWER = [
    0.2,
    -0.1,
    1.0,
    math.log(0.3),
    0.1,
    0.0,
    -0.1,
    *(30 * np.array([math.cos(1.0), math.sin(1.0)])),
    2.0,
    1.0,
    -2.0,
]


def test_body_round_trips_to_the_camera(tmp_path: Path) -> None:
    network = load_pointnet(ModelSpec(str(body(tmp_path, ANSWER))))
    points = patch()
    found = network.locate([points, points], ["car", "car"], CAMERA)  # a fixed batch of one is run twice
    assert len(found) == 2
    frustum = frustum_of(points, network.manifest.points)
    centre = frustum.to_camera(np.array([0.2, -0.1, 1.0]))
    np.testing.assert_allclose(found.centres_cam_m(CAMERA), [centre, centre], atol=1e-5)
    np.testing.assert_allclose(found.size_m[0], np.exp([0.1, 0.0, -0.1]) * [4.0, 2.0, 1.5], rtol=1e-5)
    np.testing.assert_allclose(found.sigma_depth_m, math.sqrt(2) * 0.3, rtol=1e-5)
    # The yaw is against the box's ray, alpha against the centre's
    turn = math.atan2(centre[0], centre[2]) - math.atan(3.0 / 12.0)
    np.testing.assert_allclose(found.alpha_rad, 0.5 + turn, atol=1e-5)
    assert (found.flip < 0.5).all()
    assert (found.sigma_alpha_rad < 0.1).all()


def test_front_may_be_reversed(tmp_path: Path) -> None:
    flipped = [*ANSWER[:9], -2.0, -1.0, -2.0]
    found = load_pointnet(ModelSpec(str(body(tmp_path, flipped)))).locate([patch(0.0)], ["car"], CAMERA)
    np.testing.assert_allclose(found.alpha_rad, 0.5 - math.pi, atol=0.03)


def test_frustum_pointnets_own_outputs(tmp_path: Path) -> None:
    scores, residuals = np.zeros((1, 12)), np.zeros((1, 12))
    scores[0, 9], residuals[0, 9] = 5.0, 0.5  # 270 deg and a quarter bin: about down, from the right
    size_residuals = np.zeros((1, 2, 3))
    size_residuals[0, 1] = [0.1, 0.0, 0.0]
    answers = {
        "centre": np.array([[0.0, 0.0, 14.0]]),
        "hs": scores,
        "hr": residuals,
        "ss": np.array([[0.0, 1.0]]),
        "sr": size_residuals,
    }
    path = answering(tmp_path, BINS, answers, {"points": (1, 64, 3), "class": (1, 2)})
    found = load_pointnet(ModelSpec(str(path))).locate([patch(0.0)], ["truck"], CAMERA)
    np.testing.assert_allclose(found.size_m, [[11.0, 2.5, 3.0]], rtol=1e-6)
    np.testing.assert_allclose(found.depth_m, 14.0)
    # 270 deg about down from the right is ahead, 0 here; a quarter of 30 deg more is to the right
    np.testing.assert_allclose(found.alpha_rad, -math.radians(7.5), atol=1e-6)
    np.testing.assert_allclose(found.sigma_depth_m, 0.05 * 14.0)


def test_box_without_points_has_an_unknown_body(tmp_path: Path) -> None:
    network = load_pointnet(ModelSpec(str(body(tmp_path, ANSWER))))
    found = network.locate([patch()[:10], patch()], ["car", "car"], CAMERA)
    assert np.isinf(found.sigma_depth_m).tolist() == [True, False]
    nothing = network.locate([], [], CAMERA)
    assert len(nothing) == 0


def test_non_finite_output_is_reported(tmp_path: Path) -> None:
    network = load_pointnet(ModelSpec(str(body(tmp_path, [math.nan, *ANSWER[1:]]))))
    assert network.locate([patch()], ["car"], CAMERA) is None


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (('[points]\nname = "points"', '[points]\nname = "cloud"'), "points.name"),
        (('output = "body"', 'output = "other"'), "other"),
        (("count = 64", "count = 8"), "count"),
        (('features = ["x", "y", "z", "u", "v", "log_depth"]', 'features = ["x", "x", "z"]'), "distinct"),
        (("count = 64", 'count = 64\nclass_name = "c"'), "class_name"),
        (('role = "pointnet"', 'role = "detector"'), "role"),
        (("mean_m = [4.0, 2.0, 1.5]", "mean_m = [4.0, 0.0, 1.5]"), "mean_m"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(tmp_path: Path, change: tuple[str, str], named: str) -> None:
    assert change[0] in BODY
    with pytest.raises(ModelError, match=named):
        load_pointnet(ModelSpec(str(body(tmp_path, ANSWER, text=BODY.replace(*change)))))


def test_a_network_of_another_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"body of shape \('N', 12\)"):
        load_pointnet(ModelSpec(str(body(tmp_path, ANSWER[:11]))))
    path = body(tmp_path, ANSWER, text=BODY.replace("count = 64", "count = 32"))
    with pytest.raises(ModelError, match="onnxruntime"):
        load_pointnet(ModelSpec(str(path)))


@given(st.floats(-0.6, 0.6), st.floats(4.0, 40.0))
def test_rotated_and_centred_points_round_trip(slope: float, z_m: float) -> None:
    points = patch(slope * z_m, z_m)
    frustum = frustum_of(points, Points(name="p", count=64, features=("x", "y", "z", "u", "v", "log_depth")))
    back = np.array([frustum.to_camera(p) for p in frustum.features[:3].T.astype(np.float64)])
    # Each is one of the patch; the wall behind is left out
    assert (np.abs(back[:, None] - points[None]).sum(axis=-1).min(axis=1) < 1e-4).all()
    assert (back[:, 2] < z_m + 1.0).all()
    assert np.abs(frustum.features[3:5]).max() <= 1.0 + 1e-6
    np.testing.assert_allclose(frustum.features[5], math.log(z_m / 20.0), atol=1e-6)
    # The box's middle is straight ahead of the rotated camera
    slopes = points[:, 0] / points[:, 2]
    assert math.tan(frustum.azimuth_rad) == pytest.approx((slopes.min() + slopes.max()) / 2.0)
