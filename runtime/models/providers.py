"""What computes a network on this computer: the CPU, or what else is there, wins a second of measurement and agrees.

Which there is depends on the package of onnxruntime: onnxruntime-openvino and onnxruntime-gpu bring more. One that is
asked for by name and is not there gives way to the CPU, and each frame says so (`provider_missing`).
"""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Collection
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.perception import ModelSpec, Network, load_network

MEASURED_S = 1.0  # of all providers together
MIN_RUNS = 3
# Of each output the RMS difference to the CPU's, by its RMS. A network that is off by more is computed otherwise than
# it was tested: OpenVINO rounds our network's 8 bits so that it is off by 7.5 %, and two in floats by less than .01 %
TOLERANCE_REL = 0.02
WINS_BY = 0.95  # of the CPU's time: less of a gain is noise

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Measured:
    """Of one provider: the median of a run, how far off it is by RMS, and why it does not run, if so."""

    ms: float
    off_rel: float
    problem: str = ""

    @property
    def agrees(self) -> bool:
        """Whether it runs and gives what the CPU gives."""
        return not self.problem and self.off_rel <= TOLERANCE_REL


def compared(
    role: str,
    spec: ModelSpec,
    providers: Collection[str],
    within_s: float = MEASURED_S,
    most_threads: int | None = None,
) -> dict[str, Measured]:
    """Provider -> its figures, on an image of noise of the network's size; "cpu" is the measure of the others."""
    out: dict[str, Measured] = {}
    truth: dict[str, np.ndarray] = {}
    for provider in ("cpu", *(each for each in providers if each != "cpu")):
        network = load_network(role, msgspec.structs.replace(spec, provider=provider), most_threads)
        if network.provider != provider:
            out[provider] = Measured(float("inf"), float("inf"), network.fell_back)
            continue
        size = network.manifest.input
        image = np.random.default_rng(0).integers(0, 255, (size.height_px, size.width_px, 3), np.uint8)
        found = network.answer(image)
        truth = truth or found
        off = max(_off(found[name], truth[name]) for name in found)
        out[provider] = Measured(_median_ms(network, within_s / len(providers)), off)
    return out


def chosen(role: str, spec: ModelSpec, asked: str, here: Collection[str], most_threads: int | None = None) -> ModelSpec:
    """The network with the provider that computes it; `asked` is perceive.provider: the network's own goes before."""
    asked = spec.provider or asked
    if asked != "auto":
        return msgspec.structs.replace(spec, provider=asked)
    if set(here) == {"cpu"}:
        return msgspec.structs.replace(spec, provider="cpu")
    figures = compared(role, spec, here, most_threads=most_threads)
    best = min((name for name, found in figures.items() if found.agrees), key=lambda name: figures[name].ms)
    if figures[best].ms > WINS_BY * figures["cpu"].ms:
        best = "cpu"
    said = ", ".join(
        f"{name} {found.ms:.1f} ms"
        if found.agrees
        else f"{name} not ({found.problem or f'off by {found.off_rel:.1%}'})"
        for name, found in figures.items()
    )
    log.info("%s: computed by %s (%s)", role, best, said)
    return msgspec.structs.replace(spec, provider=best)


def _off(found: np.ndarray, truth: np.ndarray) -> float:
    scale = float(np.sqrt(np.mean(np.square(truth, dtype=np.float64))))
    return float(np.sqrt(np.mean(np.square(found - truth, dtype=np.float64)))) / max(scale, 1e-9)


def _median_ms(network: Network, within_s: float) -> float:
    until_s, took_ms = time.monotonic() + within_s, list[float]()
    while len(took_ms) < MIN_RUNS or time.monotonic() < until_s:
        begun_s = time.perf_counter()
        network.infer()
        took_ms.append((time.perf_counter() - begun_s) * 1e3)
    return statistics.median(took_ms)
