"""Properties of the group SE(2)."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2, wrap

metres = st.floats(-1e3, 1e3)
angles = st.floats(-math.pi, math.pi, exclude_max=True)
poses = st.builds(SE2, metres, metres, angles)
twists = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)).map(np.array)
small_twists = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1e-5, 1e-5)).map(np.array)


def assert_same(a: SE2, b: SE2, tol: float = 1e-8) -> None:
    assert math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) < tol
    assert abs(wrap(a.yaw_rad - b.yaw_rad)) < tol


@given(poses, poses, poses)
def test_associative(a: SE2, b: SE2, c: SE2) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_identity_and_inverse(a: SE2) -> None:
    assert_same(a @ SE2(), a)
    assert_same(SE2() @ a, a)
    assert_same(a @ a.inverse(), SE2())
    assert_same(a.inverse() @ a, SE2())


@given(poses, poses)
def test_between_undoes_composition(a: SE2, b: SE2) -> None:
    assert_same(a @ a.between(b), b)


@given(poses, poses, metres, metres)
def test_acts_on_points(a: SE2, b: SE2, x: float, y: float) -> None:
    p = np.array([x, y])
    np.testing.assert_allclose((a @ b) @ p, a @ (b @ p), atol=1e-8)
    np.testing.assert_allclose(np.append(a @ p, 1.0), a.matrix() @ [x, y, 1.0], atol=1e-8)


@given(twists | small_twists)
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(SE2.exp(xi).log(), xi, atol=1e-9)


@given(st.builds(SE2, metres, metres, st.floats(-3.1, 3.1)))
@example(SE2(0.0, 225.0, 1e-6))
def test_exp_undoes_log(a: SE2) -> None:
    assert_same(SE2.exp(a.log()), a)


@given(twists, st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_exp_is_a_one_parameter_subgroup(xi: np.ndarray, s: float, t: float) -> None:
    assert_same(SE2.exp(s * xi) @ SE2.exp(t * xi), SE2.exp((s + t) * xi))


@given(poses, st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-1.5, 1.5)).map(np.array))
def test_adjoint_moves_twists(a: SE2, xi: np.ndarray) -> None:
    assert_same(a @ SE2.exp(xi), SE2.exp(a.adjoint() @ xi) @ a, tol=1e-6)


@given(st.floats(-1e4, 1e4))
def test_wrap(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_refuses_what_is_not_finite(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        SE2(0.0, bad, 0.0)
    with pytest.raises(msgspec.ValidationError, match="finite"):
        msgspec.convert([0.0, 0.0, bad], SE2)
