"""External odometry: its motions are used as given, without a pose there is no motion, unusable files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.geometry.timed_poses import TimedPoses
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.odometry.external import ExternalConfig, ExternalOdometry
from birdslam.odometry.motion import Motion
from birdslam.perception import Perception, Ready
from birdslam.runtime.configuration import Configuration, ConfigurationError, SourceConfig
from birdslam.runtime.nodes.ego_motion import external_odometry
from birdslam.runtime.nodes.sources import open_source
from birdslam.sources.odometry_file import check_odometry, read_odometry
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.trajectory import ego_pose, inverse, kitti_row, mount_pose, tum_row
from birdslam.types import NS_PER_S, Attitude, Estimate, Frame, Status

MOUNT = GroundPlane(1.65, 0.02, 0.0)
CAMERA = Camera(width_px=640, height_px=360, fx_px=500.0, fy_px=500.0, cx_px=320.0, cy_px=180.0, height_m=1.65)
STEP = SE2(1.0, 0.02, 0.01)
BOXES = np.zeros((0, 4))
IMAGE = np.zeros((360, 640), np.uint8)


def egos(n: int) -> list[SE2]:
    out = [SE2(5.0, -3.0, 1.0)]  # a separate world
    for _ in range(n - 1):
        out.append(out[-1] @ STEP)
    return out


def trajectory(n: int, rate_hz: float = 10.0, ego: bool = False, times: bool = True) -> TimedPoses:
    level = Attitude(z_m=0.0, pitch_rad=0.0, roll_rad=0.0)
    poses = np.array([ego_pose(T, level) for T in egos(n)])
    if not ego:
        poses = poses @ mount_pose(CAMERA.ground)
    t_ns = np.round(np.arange(n) / rate_hz * NS_PER_S).astype(np.int64)
    return TimedPoses(poses, t_ns if times else None)


def motions(odometry: ExternalOdometry, times_ns: list[int]) -> list[Motion | None]:
    return [odometry.estimate(None, k, t, BOXES) for k, t in enumerate(times_ns)]


@pytest.mark.parametrize("ego", [False, True], ids=["camera", "ego"])
@pytest.mark.parametrize("times", [False, True], ids=["rows", "times"])
def test_motions_are_those_of_the_file(ego: bool, times: bool) -> None:
    told = trajectory(6, ego=ego, times=times)
    found = motions(ExternalOdometry(CAMERA, told, ExternalConfig(ego=ego)), [k * NS_PER_S // 10 for k in range(6)])
    assert found[0] is None
    for k, motion in enumerate(found[1:], start=1):
        assert (motion.from_frame, motion.to_frame, motion.status) == (k - 1, k, ())
        np.testing.assert_allclose(motion.T_prev_curr.between(STEP).log(), 0.0, atol=1e-9)
        sigma = np.sqrt(np.diag(motion.cov))
        assert 0.02 <= sigma[0] < 0.021  # 2 % of the metre
        assert motion.scale_sigma_rel == 0.02


@given(st.lists(st.floats(0.0, 0.9), min_size=2, max_size=8, unique=True))
def test_poses_are_interpolated(times_s: list[float]) -> None:
    times_ns = sorted(round(t * NS_PER_S) for t in times_s)
    if len(set(times_ns)) < len(times_ns):
        return
    told = trajectory(10)
    found = motions(ExternalOdometry(CAMERA, told, ExternalConfig()), times_ns)[1:]
    way = SE2()
    for motion in found:
        assert motion.status == ()
        way = way @ motion.T_prev_curr
    first, last = (told.at(0, t, NS_PER_S) for t in (times_ns[0], times_ns[-1]))
    assert np.hypot(way.x_m, way.y_m) == pytest.approx(float(np.linalg.norm(last.p - first.p)), abs=1e-6)


def test_missing_poses_are_not_invented() -> None:
    told = trajectory(40)
    kept = (np.arange(40) < 10) | (np.arange(40) >= 16)
    odometry = ExternalOdometry(CAMERA, TimedPoses(told.poses[kept], told.t_ns[kept]), ExternalConfig())
    found = motions(odometry, told.t_ns.tolist())
    hole = [m for m in found[10:16] if m is not None]
    assert len(hole) == 6
    assert all(m.status == (Status.ODOMETRY_COASTING,) and m.from_frame == 9 for m in hole)
    spread = [float(np.trace(m.cov)) for m in hole]
    assert spread == sorted(spread)
    back = found[16]
    assert (back.from_frame, back.status) == (9, ())
    goal = egos(40)[9].between(egos(40)[16])
    np.testing.assert_allclose(back.T_prev_curr.between(goal).log(), 0.0, atol=1e-9)


def driven(odometry: ExternalOdometry, times_ns: list[int]) -> list[Estimate]:
    """The front end and the graph over images that show nothing."""
    front = FrontEnd(CAMERA, FrontEndConfig(), odometry)
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    nothing = Ready(Perception(None, None, {}, ()))
    return [graph.optimise(front.measure(Frame(k, t, t, t, IMAGE), nothing)) for k, t in enumerate(times_ns)]


def test_a_drive_follows_the_file_and_is_invalid_where_it_ended() -> None:
    times_ns = [k * NS_PER_S // 10 for k in range(60)]
    found = driven(ExternalOdometry(CAMERA, trajectory(30), ExternalConfig()), times_ns)
    start = egos(30)
    for k in (5, 15, 29):
        gap = found[k].T_world_ego.between(start[0].between(start[k]))
        np.testing.assert_allclose(gap.log(), 0.0, atol=1e-6)
        assert found[k].valid
    assert Status.ODOMETRY_COASTING in found[35].status
    assert not any(e.valid for e in found[52:])
    assert all(Status.NOT_INITIALISED in e.status for e in found[52:])


def test_times_of_another_clock_give_a_status() -> None:
    late = [k * NS_PER_S // 10 + 1000 * NS_PER_S for k in range(5)]
    found = driven(ExternalOdometry(CAMERA, trajectory(30), ExternalConfig()), late)
    assert all(not e.valid and Status.NOT_INITIALISED in e.status for e in found)


def tum(path: Path, told: TimedPoses) -> Path:
    assert told.t_ns is not None
    lines = [tum_row(int(t), pose) for t, pose in zip(told.t_ns, told.poses, strict=True)]
    path.write_text("# t x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def kitti(path: Path, poses: NDArray[np.float64]) -> Path:
    path.write_text("".join(kitti_row(inverse(poses[0]) @ pose) + "\n" for pose in poses))
    return path


def test_both_kinds_of_file_are_read(tmp_path: Path) -> None:
    told = trajectory(12)
    by_time, by_row = read_odometry(tum(tmp_path / "a", told)), read_odometry(kitti(tmp_path / "b", told.poses))
    assert by_time.t_ns is not None
    np.testing.assert_array_equal(by_time.t_ns, told.t_ns)
    np.testing.assert_allclose(by_time.poses, told.poses, atol=1e-6)
    assert by_row.t_ns is None
    np.testing.assert_allclose(by_row.poses, inverse(told.poses[0]) @ told.poses, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "has 0 poses"),
        ("0.0 0 0 0 0 0 0 1\n", "has 1 poses"),
        ("0.0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0\n", "line 2 is not a TUM pose"),
        ("0.0 0 0 0 0 0 0 1\n0.1 nan 0 0 0 0 0 1\n", "line 2 is not a TUM pose"),
        ("0.0 0 0 0 0 0 0 1\n0.1 0 0 0 1 1 0 1\n", "no unit quaternion"),
        ("0.1 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n", "pose 1 is not later"),
        ("1e18 0 0 0 0 0 0 1\n2e18 0 0 0 0 0 0 1\n", "not in seconds"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0\n", "line 2 is not a KITTI pose"),
        ("time,x,y\n", "line 1 is not a TUM pose"),
    ],
)
def test_a_malformed_file_is_an_error_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "odometry.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match=says) as told:
        read_odometry(path)
    assert str(path) in str(told.value)


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="can't be read"):
        read_odometry(tmp_path / "none.txt")


def test_a_file_of_another_drive_is_refused(tmp_path: Path) -> None:
    demo = open_recording("demo")
    short = kitti(tmp_path / "short", trajectory(12).poses)
    with pytest.raises(DatasetError, match=f"12 poses for {len(demo)} frames"):
        check_odometry(demo, short)
    whole = kitti(tmp_path / "whole", trajectory(len(demo)).poses)
    check_odometry(demo, whole)
    with pytest.raises(DatasetError, match="use TUM lines"):
        check_odometry(demo, whole, stride=2)
    early = trajectory(12)
    with pytest.raises(DatasetError, match="are outside the recording's"):
        check_odometry(demo, tum(tmp_path / "early", TimedPoses(early.poses, early.t_ns - 10**12)))


def test_configuration_selects_the_odometry(tmp_path: Path) -> None:
    path = kitti(tmp_path / "short", trajectory(12).poses)
    configuration = Configuration(source=SourceConfig(uri="demo", odometry=str(path)))
    assert isinstance(external_odometry(configuration, CAMERA), ExternalOdometry)
    assert external_odometry(Configuration(), CAMERA) is None
    with pytest.raises(DatasetError, match="12 poses for"):
        open_source(configuration)
    looped = Configuration(source=SourceConfig(uri="demo", odometry=str(path), loop=True))
    with pytest.raises(ConfigurationError, match=r"remove source\.loop"):
        open_source(looped)
    live = Configuration(source=SourceConfig(uri="v4l2:/dev/video0", odometry=str(path)), camera=CAMERA)
    with pytest.raises(ConfigurationError, match="for recordings"):
        open_source(live)
