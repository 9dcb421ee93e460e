"""A pose graph restored from a checkpoint continues bit for bit, or raises an error with the reason."""

from __future__ import annotations

from functools import cache

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.graph.checkpoint import CheckpointError, pack, packed, unpack, unpacked
from birdslam.graph.factors.landmark_points import LandmarkPoints, LandmarksState
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.types import Measurements, Status
from tests.records import new_measurements

SETTINGS = {
    "measured": (GraphConfig(), WeightsConfig()),
    "all edges": (GraphConfig(max_vehicles=3), WeightsConfig(leave_out=())),
    "paper": (GraphConfig(ego_nodes=1, constant_velocity=False), WeightsConfig(mode="paper")),
}
WORLDS = [drive(DriveConfig(frames=120, vehicles=5, outliers=0.05, drop=0.1), seed).measurements for seed in range(3)]


def goes_on(graph: PoseGraph, log: list[Measurements]) -> bytes:
    """The graph's estimates of these frames."""
    return b"".join(msgspec.msgpack.encode((graph.optimise(m), graph.map_update(), graph.epoch)) for m in log)


def worn(log: list[Measurements], break_at: int, blind_at: int) -> list[Measurements]:
    """With a new epoch somewhere, and a frame without a picture."""
    log = list(log)
    log[break_at % len(log)] = replace(log[break_at % len(log)], cc=None)
    blind = log[blind_at % len(log)]
    log[blind_at % len(log)] = new_measurements(
        frame_id=blind.frame_id, t_source_ns=blind.t_source_ns, status=(Status.FRAME_UNREADABLE,)
    )
    return log


@settings(max_examples=8)
@given(
    world=st.sampled_from(WORLDS),
    cut=st.integers(0, 200),
    break_at=st.integers(0, 200),
    blind_at=st.integers(0, 200),
    mode=st.sampled_from(sorted(SETTINGS)),
    taken=st.booleans(),
)
def test_a_restored_graph_continues_bit_for_bit(
    world: list[Measurements], cut: int, break_at: int, blind_at: int, mode: str, taken: bool
) -> None:
    log = worn(world, break_at, blind_at)
    cut %= len(log) + 1
    graph = PoseGraph(*SETTINGS[mode], epoch=7)
    for m in log[:cut]:
        graph.optimise(m)
        if taken:
            graph.map_update()
    data = graph.checkpoint()
    restored = PoseGraph.restore(data, *SETTINGS[mode])
    assert restored.checkpoint() == data
    assert goes_on(restored, log[cut:]) == goes_on(graph, log[cut:])


def test_a_checkpoint_after_an_edge_from_an_older_frame() -> None:
    graph, log = PoseGraph(*SETTINGS["measured"]), list(WORLDS[0][:10])
    before, last = log[-2].cc, log[-1].cc
    assert last is not None
    log[-1] = replace(
        log[-1], cc=replace(last, from_frame=before.from_frame, T_from_to=before.T_from_to @ last.T_from_to)
    )
    log = [msgspec.convert(msgspec.to_builtins(m, enc_hook=float), Measurements) for m in log]  # as they come by wire
    for m in log:
        graph.optimise(m)
    assert graph.epoch == 0
    data = graph.checkpoint()
    assert PoseGraph.restore(data, *SETTINGS["measured"]).checkpoint() == data


@cache
def checkpoint() -> bytes:
    """Of a graph that has taken in 30 frames."""
    graph = PoseGraph(*SETTINGS["measured"])
    for m in WORLDS[0][:30]:
        graph.optimise(m)
    return graph.checkpoint()


@given(where=st.integers(0, 10**6), bit=st.integers(0, 7))
def test_a_flipped_bit_is_detected(where: int, bit: int) -> None:
    torn = bytearray(checkpoint())
    torn[where % len(torn)] ^= 1 << bit
    with pytest.raises(CheckpointError, match=r"damaged|not a checkpoint|version"):
        PoseGraph.restore(bytes(torn), *SETTINGS["measured"])


@given(length=st.integers(0, 10**6))
def test_a_truncated_checkpoint_is_detected(length: int) -> None:
    data = checkpoint()
    with pytest.raises(CheckpointError, match=r"damaged|not a checkpoint|version"):
        PoseGraph.restore(data[: length % len(data)], *SETTINGS["measured"])


@pytest.mark.parametrize("data", [b"", b"\x00" * 100, msgspec.msgpack.encode({"epoch": 1})])
def test_foreign_bytes_are_rejected(data: bytes) -> None:
    with pytest.raises(CheckpointError, match="not a checkpoint of a pose graph"):
        PoseGraph.restore(data, *SETTINGS["measured"])


def test_other_settings_are_named() -> None:
    data = checkpoint()
    with pytest.raises(CheckpointError, match=r"graph\.ego_nodes = 4, this graph has 5"):
        PoseGraph.restore(data, GraphConfig(ego_nodes=5), WeightsConfig())
    with pytest.raises(CheckpointError, match=r"weights\.mode = measured, this graph has paper"):
        PoseGraph.restore(data, GraphConfig(), WeightsConfig(mode="paper"))


def test_inconsistent_parts_are_rejected() -> None:
    """Whole by its sum, but not what this code writes."""
    whole = unpack(checkpoint(), PoseGraph(*SETTINGS["measured"]).settings)
    begun = whole.started
    landmarks: LandmarksState = unpacked(begun.factors[LandmarkPoints.name], LandmarksState)
    torn = packed(replace(landmarks, frames=landmarks.frames[1:]))
    for broken in (
        replace(begun, vehicles=begun.vehicles[1:]),
        replace(begun, window=replace(begun.window, of_egos=begun.window.of_egos[1:])),
        replace(begun, window=replace(begun.window, with_egos=begun.window.with_egos[1:])),
        replace(begun, window=replace(begun.window, of_vehicles=begun.window.of_vehicles[1:])),
        replace(begun, window=replace(begun.window, next_node=99)),
        replace(begun, factors=begun.factors | {LandmarkPoints.name: torn}),
    ):
        with pytest.raises(CheckpointError, match="is inconsistent"):
            PoseGraph.restore(pack(replace(whole, started=broken)), *SETTINGS["measured"])
    for lost in ({}, dict.fromkeys(begun.factors, b"")):
        with pytest.raises(CheckpointError, match="can't be read"):
            PoseGraph.restore(pack(replace(whole, started=replace(begun, factors=lost))), *SETTINGS["measured"])
