"""Records validate themselves, and an older reader accepts a newer sender."""

import math
from collections.abc import Iterator

import msgspec
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.loops.map_pose import MapState
from birdslam.types import (
    INVALIDATING,
    EgoEdge,
    Estimate,
    LandmarkEdge,
    LandmarkKind,
    LanePoint,
    MapUpdate,
    MotionEdge,
    Status,
    VehicleEdge,
)

EYE3 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def test_a_status_of_a_newer_sender_is_unknown_not_an_error() -> None:
    assert msgspec.convert("quantum_fog", Status) is Status.UNKNOWN
    assert msgspec.convert("standstill", Status) is Status.STANDSTILL
    assert msgspec.convert("nearly_lost", MapState) is MapState.LOST
    assert Status.UNKNOWN not in INVALIDATING  # `valid` was decided by the sender
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(3, Status)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_numbers_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        EgoEdge(from_frame=0, to_frame=1, T_from_to=SE2(), cov=(*EYE3[:8], bad))
    with pytest.raises(ValueError, match="finite"):
        LandmarkEdge(landmark=0, frame=0, x_m=bad, y_m=0.0, cov=(1.0, 0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="finite"):
        MapUpdate(epoch=0, frame_id=0, lanes_m=((0.0, bad),))
    with pytest.raises(ValueError, match="finite"):
        VehicleEdge(vehicle=0, frame=0, T_ego_vehicle=SE2(), cov=EYE3, box_px=(0.0, bad, 1.0, 1.0))


SOUND = (
    LandmarkEdge(landmark=0, frame=0, x_m=1.0, y_m=2.0, cov=(1.0, 0.5, 0.5, 1.0)),
    LanePoint(1.0, 2.0),
    MotionEdge(vehicle=0, from_frame=0, to_frame=1, T_from_to=SE2(), cov=EYE3),
    VehicleEdge(vehicle=0, frame=0, T_ego_vehicle=SE2(), cov=EYE3, box_px=(0.0, 0.0, 1.0, 1.0), sigma_log_height=0.1),
)


def numbers_of(record: msgspec.Struct) -> Iterator[tuple[str, int | None]]:
    """Every number of a record, as its field and, in a tuple, its place there; a pose checks its own."""
    for field in record.__struct_fields__:
        value = getattr(record, field)
        if isinstance(value, float):
            yield field, None
        elif isinstance(value, tuple):
            yield from ((field, k) for k in range(len(value)))


@pytest.mark.parametrize("record", SOUND, ids=lambda record: type(record).__name__)
def test_each_number_of_a_record_is_checked(record: msgspec.Struct) -> None:
    for field, k in numbers_of(record):
        value = getattr(record, field)
        side = round(math.sqrt(len(value))) if field == "cov" else 0
        bad = [(math.nan, "finite"), (math.inf, "finite"), (-math.inf, "finite")]
        if side and k is not None and k % (side + 1) == 0:
            bad.append((-1.0, "negative variance"))
        for number, why in bad:
            changed = number if k is None else (*value[:k], number, *value[k + 1 :])
            with pytest.raises(ValueError, match=why):
                msgspec.structs.replace(record, **{field: changed})


@pytest.mark.parametrize("lane_ids", [(1,), (1, 2, 3)])
def test_every_lane_point_has_an_id_or_none_has(lane_ids: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"lane_ids has {len(lane_ids)} entries for 2 points"):
        MapUpdate(epoch=0, frame_id=0, lanes_m=((0.0, 0.0), (1.0, 0.0)), lane_ids=lane_ids)


def test_opposite_infinities_do_not_cancel() -> None:
    with pytest.raises(ValueError, match="finite"):
        EgoEdge(from_frame=0, to_frame=1, T_from_to=SE2(), cov=(1.0, math.inf, 0.0, -math.inf, 1.0, 0.0, 0.0, 0.0, 1.0))


def test_a_negative_variance_is_refused() -> None:
    with pytest.raises(ValueError, match="negative variance"):
        EgoEdge(from_frame=0, to_frame=1, T_from_to=SE2(), cov=(*EYE3[:4], -1.0, *EYE3[5:]))


def test_a_covariance_of_the_wrong_size_is_refused_on_decoding() -> None:
    stamps = {"epoch": 0, "frame_id": 0, "t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0, "valid": True}
    with pytest.raises(msgspec.ValidationError, match=r"length >= 9.*cov"):
        msgspec.convert({**stamps, "T_world_ego": [0, 0, 0], "cov": [1.0] * 4}, Estimate)


def test_a_station_of_an_older_record_keeps_its_meaning() -> None:
    """Before `kind` existed, ids from 2**48 on were stations."""
    cov = [1.0, 0.0, 0.0, 1.0]
    station, point = (msgspec.convert([landmark, 5, 2.0, 1.0, cov], LandmarkEdge) for landmark in ((1 << 48) + 41, 41))
    assert (station.kind, station.landmark) == (LandmarkKind.LANE_STATION, 41)
    assert (point.kind, point.landmark) == (LandmarkKind.ROAD_POINT, 41)
    assert msgspec.convert(msgspec.to_builtins(station), LandmarkEdge) == station
