"""The summary of a drive: every status has a meaning, and no sentence claims more than the counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.graph.camera_scale import with_camera_scale
from birdslam.outputs.plain_words import MEANINGS, REMEDIES, DriveCounts, LengthsBy, readme, verdict
from birdslam.types import INVALIDATING, Status
from tests.records import new_estimate, new_vehicle


def drive(frames: int = 100, invalid: int = 0, **more: object) -> DriveCounts:
    plain = {
        "invalid_by": {},
        "statuses": {},
        "speed_sources": {"road": frames},
        "path_m": 200.0,
        "valid_path_m": 180.0,
        "scale_sigma_rel": 0.03 if frames > invalid else None,
        "camera_sigma_rel": 0.0,
    }
    return DriveCounts(frames=frames, invalid_frames=invalid, **{**plain, **more})


def test_every_status_has_a_meaning() -> None:
    assert set(MEANINGS) == set(Status)
    for words in (*MEANINGS.values(), *REMEDIES.values()):
        assert 5 < len(words) < 110
        assert "_" not in words
    assert len(set(MEANINGS.values())) == len(Status)


@given(st.integers(0, 10_000), st.data())
def test_share_is_100_percent_only_if_all_frames_are_valid(frames: int, data: st.DataObject) -> None:
    invalid = data.draw(st.integers(0, frames))
    first, *_ = verdict(drive(frames, invalid))
    if not frames:
        assert first.startswith("No frame was processed")
    elif not invalid:
        assert first.startswith(f"All {frames} frames")
    elif invalid == frames:
        assert first.startswith("No frame is valid")
    else:
        share = int(first.split()[0])
        assert 1 <= share <= 99
        assert share == pytest.approx(100.0 * (frames - invalid) / frames, abs=1.0)


def test_truncated_film_is_reported_once() -> None:
    assert sum("cut off" in said for said in verdict(drive(100, 1, ends_unreadable=True))) == 1
    assert not any("cut off" in said for said in verdict(drive(100, 1, invalid_by={"frame_unreadable": 1})))


def test_a_stationary_camera_is_named_instead_of_a_remedy_for_the_scale() -> None:
    statuses = {"scale_invalid": 100, "standstill": 60}
    said = "\n".join(verdict(drive(100, 100, invalid_by={"scale_invalid": 100}, statuses=statuses)))
    assert "hardly moves" in said
    assert "Remedy" not in said
    said = "\n".join(verdict(drive(100, 99, invalid_by={"scale_invalid": 99}, statuses=statuses)))
    assert "Remedy for scale_invalid" in said


def test_reasons_are_listed_by_frequency() -> None:
    said = verdict(drive(100, 30, invalid_by={"camera_dark": 5, "scale_invalid": 30}, statuses={"scale_invalid": 30}))
    reasons = [line for line in said if line.startswith("Not valid")]
    assert [line.split()[2] for line in reasons] == ["30", "5"]
    assert "determine the scale" in reasons[0]
    assert any("--speed FILE" in line for line in said)


def test_unmeasured_height_is_recommended_to_measure() -> None:
    by_cars = LengthsBy("the camera's height of 1.40 m (by the size of 12 cars, +- 11%)", 0.11)
    said = verdict(drive(scale_sigma_rel=0.12, camera_sigma_rel=0.11, lengths_by=by_cars))
    assert any("Lengths are accurate to 12%" in line and by_cars.words in line for line in said)
    (step,) = [line for line in said if line.startswith("Next")]
    assert "--height M" in step
    assert "5 % of height is 5 % of all lengths" in step
    stated = LengthsBy("the camera's height of 1.35 m (as stated) and its focal length, +- 25%", 0.0, 0.25)
    (step,) = [line for line in verdict(drive(camera_sigma_rel=0.25, lengths_by=stated)) if line.startswith("Next")]
    assert "--fov DEG" in step
    said = verdict(drive(camera_sigma_rel=0.25, lengths_by=stated._replace(view_is_stated=True)))
    (step,) = [line for line in said if line.startswith("Next")]
    assert step.startswith("Next: photograph a chessboard")
    both = LengthsBy("both", 0.1, 0.25)
    first, second = [line for line in verdict(drive(camera_sigma_rel=0.27, lengths_by=both)) if line.startswith("Next")]
    assert "--fov" in first
    assert "--height" in second


def test_the_readme_names_each_file() -> None:
    text = readme("drive", ["All 3 frames are valid (2 m)."], {"bev.png": "from above", "tracks": "the vehicles"})
    assert "All 3 frames are valid (2 m)." in text
    assert text.index("bev.png") < text.index("tracks")
    assert text.endswith("\n")


PLACES = st.builds(SE2, st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-3.0, 3.0))


@given(PLACES, PLACES, st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(0.001, 0.3))
def test_uncertain_scale_affects_all_distances(
    ego: SE2, car: SE2, u_mps: float, v_mps: float, sigma_rel: float
) -> None:
    vehicle = new_vehicle(vehicle=1, T_world_vehicle=car, velocity_mps=(u_mps, v_mps), frames=3)  # fmt: skip
    sure = new_estimate(
        frame_id=1, t_source_ns=1, t_capture_ns=1, T_world_ego=ego, vehicles=(vehicle,), scale_sigma_rel=0.04
    )
    assert with_camera_scale(sure, 0.0) is sure
    found = with_camera_scale(sure, sigma_rel)
    assert found.scale_sigma_rel == pytest.approx(math.hypot(0.04, sigma_rel))
    (seen,) = found.vehicles
    for pose, cov in ((ego, found.cov), (car, seen.cov)):
        # A world that is 1 sigma larger, in the tangent at the pose: that far it is, and there alone
        larger = SE2(pose.x_m * (1.0 + sigma_rel), pose.y_m * (1.0 + sigma_rel), pose.yaw_rad)
        step = pose.between(larger)
        along = np.array([step.x_m, step.y_m, 0.0])
        assert np.reshape(cov, (3, 3)) == pytest.approx(np.outer(along, along), rel=1e-6, abs=1e-6)
    u = sigma_rel * np.array([u_mps, v_mps])
    assert np.reshape(seen.velocity_cov, (2, 2)) == pytest.approx(np.outer(u, u), rel=1e-9, abs=1e-12)


def test_an_informative_status_does_not_invalidate_a_frame() -> None:
    assert Status.SCALE_ESTIMATED not in INVALIDATING
