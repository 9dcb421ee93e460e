"""Execution providers: selection by measurement and agreement, and the reported fallback to the CPU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from birdslam.perception import ModelSpec, Network, load_network, session
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perception.network import _Bound  # private: a failing run of an accelerator is to be had no other way
from birdslam.runtime.configuration import Configuration, PerceiveConfig, SourceConfig, load
from birdslam.runtime.doctor.checks import examine
from birdslam.runtime.models import providers
from birdslam.runtime.models.providers import Measured, chosen, compared
from birdslam.runtime.nodes.inference import Inference
from birdslam.types import Frame, Status

SHIPPED = ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK))
IMAGE = np.random.default_rng(1).integers(0, 255, (96, 160, 3), np.uint8)
ABSENT = next(name for name in ("tensorrt", "cuda", "openvino") if name not in session.available_providers())


stand_in = pytest.mark.filterwarnings("ignore:Duplicate provider")  # the CPU as a provider that always starts


def by(provider: str | None) -> ModelSpec:
    return msgspec.structs.replace(SHIPPED, provider=provider)


def test_missing_provider_falls_back_to_cpu_with_reason() -> None:
    fallen, cpu = load_network("multitask", by(ABSENT)), load_network("multitask", by("cpu"))
    assert (fallen.provider, cpu.provider, cpu.fell_back) == ("cpu", "cpu", "")
    assert f"has cpu, not {ABSENT}" in fallen.fell_back
    for name, tensor in cpu.raw_outputs(IMAGE).items():
        assert np.array_equal(tensor, fallen.raw_outputs(IMAGE)[name])
    assert load_network("multitask", by("auto")).provider == "cpu"


def test_each_frame_reports_the_fallback() -> None:
    for provider, said in ((ABSENT, True), ("cpu", False), ("auto", False)):
        config = Configuration(source=SourceConfig(rate="max"), perceive=PerceiveConfig(provider=provider))
        with Inference(config) as inference:
            for k in range(2):
                perception = inference.start(Frame(k, k, k, k, IMAGE)).result()
                assert (Status.PROVIDER_MISSING in perception.status) is said


@stand_in
def test_failing_accelerator_falls_back_to_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(session.EXECUTION_PROVIDERS, "cuda", session.CPU)
    network, cpu = load_network("multitask", by("cuda")), load_network("multitask", by("cpu"))
    assert network.provider == "cuda"
    failures, infer = [0], _Bound.infer

    def failing(self: _Bound) -> bool:
        failures[0] += 1
        if failures[0] == 1:
            raise session.SESSION_ERRORS[0]("the device is gone")
        return infer(self)

    monkeypatch.setattr(_Bound, "infer", failing)
    found = network.run(IMAGE)
    assert (network.provider, network.fell_back) == ("cpu", "cuda: the device is gone")
    assert found is not None
    monkeypatch.setattr(_Bound, "infer", infer)
    for name, tensor in cpu.raw_outputs(IMAGE).items():
        assert np.array_equal(tensor, network.raw_outputs(IMAGE)[name])


class CopiesWhenBound:
    """A session and its binding as an accelerator's are: the input is copied when it is bound, not when it runs."""

    def run(self, _outputs: Any, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        return [2.0 * image for image in inputs.values()]

    def io_binding(self) -> CopiesWhenBound:
        return self

    def bind_input(self, _name: str, _device: str, _id: int, _kind: Any, shape: tuple[int, ...], place: int) -> None:
        self._input = self._at(place, shape).copy()

    def bind_output(self, _name: str, _device: str, _id: int, _kind: Any, shape: tuple[int, ...], place: int) -> None:
        self._output = self._at(place, shape)

    def run_with_iobinding(self, _binding: CopiesWhenBound) -> None:
        self._output[:] = 2.0 * self._input

    def synchronize_outputs(self) -> None:
        """At once here."""

    @staticmethod
    def _at(place: int, shape: tuple[int, ...]) -> np.ndarray:
        return np.ctypeslib.as_array(ctypes.cast(place, ctypes.POINTER(ctypes.c_float)), shape)


def test_an_accelerator_sees_the_image_of_each_run() -> None:
    image = np.zeros((1, 3, 4, 5), np.float32)
    bound = _Bound(CopiesWhenBound(), "image", image, ["out"])
    for value in (1.0, 2.0):
        image[:] = value
        assert bound.infer()
        assert (bound.tensors["out"] == 2.0 * value).all()


def figures(monkeypatch: pytest.MonkeyPatch, **found: Measured) -> list[Any]:
    calls: list[Any] = []

    def measured(*arguments: Any, **more: Any) -> dict[str, Measured]:
        calls.append(arguments)
        return found

    monkeypatch.setattr(providers, "compared", measured)
    return calls


def test_auto_selects_the_fastest_agreeing_provider(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = Measured(10.0, 0.0)
    for openvino, wanted in (
        (Measured(6.0, 0.001), "openvino"),
        (Measured(6.0, 0.3), "cpu"),  # it computes something else
        (Measured(9.9, 0.0), "cpu"),  # no gain
        (Measured(float("inf"), float("inf"), "does not start"), "cpu"),
    ):
        figures(monkeypatch, cpu=cpu, openvino=openvino)
        assert chosen("multitask", SHIPPED, "auto", ("cpu", "openvino")).provider == wanted
    calls = figures(monkeypatch, cpu=cpu)
    assert chosen("multitask", SHIPPED, "auto", ("cpu",)).provider == "cpu"
    assert chosen("multitask", SHIPPED, "cuda", ("cpu", "openvino")).provider == "cuda"
    assert chosen("multitask", by("cpu"), "cuda", ("cpu", "cuda")).provider == "cpu"  # its own goes before
    assert calls == []  # nothing was to be measured


@stand_in
def test_providers_are_measured_beside_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(session.EXECUTION_PROVIDERS, "cuda", session.CPU)
    found = compared("multitask", SHIPPED, ("cpu", "cuda", ABSENT), within_s=0.0)
    assert found["cuda"].agrees
    assert found["cuda"].off_rel == found["cpu"].off_rel == 0.0
    assert 0.0 < found["cpu"].ms < float("inf")
    if ABSENT != "cuda":
        assert not found[ABSENT].agrees
        assert f"not {ABSENT}" in found[ABSENT].problem

    def off(answer: Callable[..., Any]) -> Callable[..., Any]:
        def wrong(self: Network, image: Any) -> Any:
            return {name: t if self.provider == "cpu" else 1.1 * t for name, t in answer(self, image).items()}

        return wrong

    monkeypatch.setattr(Network, "raw_outputs", off(Network.raw_outputs))
    assert not compared("multitask", SHIPPED, ("cpu", "cuda"), within_s=0.0)["cuda"].agrees


def test_doctor_lists_what_is_there(tmp_path: Path) -> None:
    for provider, verdict in ((ABSENT, "warning"), ("cpu", "ok")):
        (row,) = [f for f in examine(load(None, {"perceive.provider": provider})) if f.what == "multitask"]
        assert (row.verdict, f"by {provider} of cpu" in row.found) == (verdict, True)


@pytest.mark.skipif("openvino" not in session.available_providers(), reason="onnxruntime-openvino is not installed")
def test_openvino_agrees_with_cpu() -> None:
    assert compared("multitask", SHIPPED, ("cpu", "openvino"), within_s=0.0)["openvino"].agrees


@stand_in
def test_missing_libraries_fall_back_to_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As TensorRT does without its own: a RuntimeError of another kind than a session's."""
    begin = session.ort.InferenceSession

    def without_libraries(content: bytes, options: Any, providers: list[Any], **more: Any) -> Any:
        if providers != [session.CPU]:
            raise RuntimeError("Please install TensorRT libraries")
        return begin(content, options, providers=providers, **more)

    monkeypatch.setitem(session.EXECUTION_PROVIDERS, "tensorrt", session.CPU)
    monkeypatch.setattr(session.ort, "InferenceSession", without_libraries)
    fallen = load_network("multitask", by("tensorrt"))
    assert (fallen.provider, fallen.fell_back) == (
        "cpu",
        "tensorrt: tensorrt does not start: Please install TensorRT libraries",
    )
