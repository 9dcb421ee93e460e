"""Selects the onnxruntime provider of a network: the fastest one whose results agree with the CPU's.

onnxruntime-openvino and onnxruntime-gpu have more providers than the CPU. A configured provider that is missing is
replaced by the CPU, with the status `provider_missing`.
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

MEASURED_S = 1.0  # for all providers together
MIN_RUNS = 3
TOLERANCE_REL = 0.02  # RMS difference of an output to the CPU's, relative to its RMS
MAX_TIME_RATIO = 0.95  # to the CPU's time: a smaller gain is noise

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Measured:
    """One provider's median run time, its RMS difference to the CPU, and why it does not run, if so."""

    ms: float
    off_rel: float
    problem: str = ""

    @property
    def agrees(self) -> bool:
        """Whether it runs and agrees with the CPU."""
        return not self.problem and self.off_rel <= TOLERANCE_REL


def compared(
    role: str,
    spec: ModelSpec,
    providers: Collection[str],
    within_s: float = MEASURED_S,
    max_threads: int | None = None,
) -> dict[str, Measured]:
    """Measures the providers on a noise image of the network's size; "cpu" is the reference."""
    out: dict[str, Measured] = {}
    truth: dict[str, np.ndarray] = {}
    for provider in ("cpu", *(each for each in providers if each != "cpu")):
        network = load_network(role, msgspec.structs.replace(spec, provider=provider), max_threads)
        if network.provider != provider:
            out[provider] = Measured(float("inf"), float("inf"), network.fell_back)
            continue
        size = network.manifest.input
        image = np.random.default_rng(0).integers(0, 255, (size.height_px, size.width_px, 3), np.uint8)
        found = network.raw_outputs(image)
        truth = truth or found
        off = max(_off(found[name], truth[name]) for name in found)
        out[provider] = Measured(_median_ms(network, within_s / len(providers)), off)
    return out


def chosen(role: str, spec: ModelSpec, asked: str, here: Collection[str], max_threads: int | None = None) -> ModelSpec:
    """Returns the network with the selected provider; its own overrides `asked`, which is perceive.provider."""
    asked = spec.provider or asked
    if asked != "auto":
        return msgspec.structs.replace(spec, provider=asked)
    if set(here) == {"cpu"}:
        return msgspec.structs.replace(spec, provider="cpu")
    figures = compared(role, spec, here, max_threads=max_threads)
    best = min((name for name, found in figures.items() if found.agrees), key=lambda name: figures[name].ms)
    if figures[best].ms > MAX_TIME_RATIO * figures["cpu"].ms:
        best = "cpu"
    summary = ", ".join(
        f"{name} {found.ms:.1f} ms"
        if found.agrees
        else f"{name} rejected ({found.problem or f'differs by {found.off_rel:.1%}'})"
        for name, found in figures.items()
    )
    log.info("%s: runs on %s (%s)", role, best, summary)
    return msgspec.structs.replace(spec, provider=best)


def _off(found: np.ndarray, truth: np.ndarray) -> float:
    scale = float(np.sqrt(np.mean(np.square(truth, dtype=np.float64))))
    return float(np.sqrt(np.mean(np.square(found - truth, dtype=np.float64)))) / max(scale, 1e-9)


def _median_ms(network: Network, within_s: float) -> float:
    until_s, took_ms = time.monotonic() + within_s, list[float]()
    while len(took_ms) < MIN_RUNS or time.monotonic() < until_s:
        start_s = time.perf_counter()
        network.infer()
        took_ms.append((time.perf_counter() - start_s) * 1e3)
    return statistics.median(took_ms)
