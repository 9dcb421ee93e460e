"""Networks on this machine: each alone, its preparation, run and reading apart, and the whole perceive step.

    python -m perf inference [--source kitti:DIR] [--model detector=F.onnx --model segmenter=G.onnx] [--output F.json]

Without `--model` these are the shipped ones, int8 and fp32. A network alone takes frame after frame. The perceive step
is the product's (runtime/nodes/inference.py and FrontEnd), paced at `--rate` with the deadline and the schedule of the
configuration: networks that are carried don't hold it up. A quantised network is one more `--model` of its role.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.perception import ModelSpec, Network, load_network
from birdslam.perception.completion import GridCompletion
from birdslam.perception.manifest import SHIPPED_NETWORKS
from birdslam.perf.errors import PerfError
from birdslam.perf.latency.live import add_run_options
from birdslam.perf.reporting.arguments import benchmark_parser, numbers
from birdslam.perf.reporting.figures import Ledger, curve, noise, spread, spread_text
from birdslam.runtime.configuration import Configuration, complete, load, parse_setting
from birdslam.runtime.fields import parted
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.nodes import front_end
from birdslam.runtime.nodes.sources import offline_frames, open_source
from birdslam.types import Frame

label = "every network, and the whole perceive step, by threads"

WARM_UP_FRAMES = 5
FRAMES_HELD = 60  # images in memory, gone through again and again

Parts = dict[str, list[float]]


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("inference", label)
    add_run_options(parser.add_argument)
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--threads", type=numbers, default=(1, 2, 3), help="a list")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each row")
    options = parser.parse_args(arguments)
    models = [tuple(text.partition("=")[::2]) for text in options.model]
    configuration, frames = _frames(options, models)
    alone_too = [*models, *_shipped(configuration)]
    with Ledger(options.output, label, source=options.source, rate=options.rate, models=alone_too) as ledger:
        for (role, path), threads in itertools.product(alone_too, options.threads):
            network = load_network(role, ModelSpec(path=path, threads=threads))
            row = _row(alone(network, frames, options.seconds))
            ledger.add(
                f"{role} {network.path.name} {threads} threads",
                _summary(row),
                network=network.describe(),
                size_bytes=network.path.stat().st_size,
                **row,
            )
        if configuration.models.completion:
            row = _row(_completion(configuration, options.seconds))
            ledger.add("completion lanes.onnx 1 threads", _summary(row), **row)
        for threads in options.threads:
            row = _row(perceive(_with_threads(configuration, threads), frames, options))
            ledger.add(f"perceive step {threads} threads", _summary(row), threads=threads, **row)


def _shipped(configuration: Configuration) -> list[tuple[str, str]]:
    """The package's own network where the configuration runs it: as it runs, and in fp32."""
    spec = configuration.models.in_use().get("multitask")
    if spec is None or configuration.models.multitask is not None:
        return []
    return [("multitask", spec.path), ("multitask", str(SHIPPED_NETWORKS / "multitask.onnx"))]


def _completion(configuration: Configuration, seconds: float) -> Parts:
    """ENet on a pair of grids, one half full: what is in them does not matter to its time."""
    shape = configuration.slam.frontend.lanes.shape
    complete_lanes = GridCompletion(shape)
    grids = np.random.default_rng(1).integers(0, 2, (2, *shape)).astype(np.float32)
    took_ms: list[float] = []
    until_s = time.perf_counter() + seconds
    while (begun_s := time.perf_counter()) < until_s:
        complete_lanes(grids)
        took_ms.append((time.perf_counter() - begun_s) * 1e3)
    return {"network": took_ms}


def _frames(options: argparse.Namespace, models: list[tuple[str, str]]) -> tuple[Configuration, list[Frame]]:
    overrides, constants = parted(dict(parse_setting(text) for text in options.set))
    overrides |= {f"models.{role}.path": path for role, path in reversed(models)}  # the first of a role
    overrides |= {"source.uri": options.source, "source.rate": options.rate}
    configuration = load(Path(options.config) if options.config else None, overrides, constants=constants)
    source = open_source(configuration)
    configuration = complete(configuration, source.camera, source.rate_hz)
    frames = [frame for frame in itertools.islice(offline_frames(source), FRAMES_HELD) if frame.image is not None]
    if not frames:
        raise PerfError(f"{options.source}: has no readable image")
    return configuration, frames


def _with_threads(configuration: Configuration, threads: int) -> Configuration:
    in_use = configuration.models.in_use()
    specs = {role: msgspec.structs.replace(spec, threads=threads) for role, spec in in_use.items()}
    return msgspec.structs.replace(configuration, models=msgspec.structs.replace(configuration.models, **specs))


def alone(network: Network, frames: list[Frame], seconds: float) -> Parts:
    """What `Network.run` does, with a clock between its parts; all views of a frame together."""
    parts: Parts = {"prepare": [], "network": [], "read": []}
    until_s = time.perf_counter() + seconds
    for number, frame in enumerate(itertools.cycle(frames)):
        image = cast(NDArray[np.uint8], frame.image)
        views, found = network.views(image), []
        took = dict.fromkeys(parts, 0.0)
        for view in views:
            begun = time.perf_counter()
            network.prepare(image, view)
            prepared = time.perf_counter()
            network.infer()
            ran = time.perf_counter()
            found.append(network.read(view))
            took["prepare"] += prepared - begun
            took["network"] += ran - prepared
            took["read"] += time.perf_counter() - ran
        begun = time.perf_counter()
        network.decoder.merge(found, views)
        took["read"] += time.perf_counter() - begun
        if number >= WARM_UP_FRAMES:
            for name, spent_s in took.items():
                parts[name].append(spent_s * 1e3)
        if time.perf_counter() > until_s and number > WARM_UP_FRAMES:
            return parts
    raise AssertionError("a cycle has no end")


def perceive(configuration: Configuration, frames: list[Frame], options: argparse.Namespace) -> Parts:
    """The product's step, live: from an image in hand to Measurements."""
    assert configuration.camera is not None
    cv2.setNumThreads(configuration.perceive.opencv_threads)
    step_ms: list[float] = []
    with Inference(configuration) as inference:
        frontend = front_end(configuration, inference)
        gc.collect()
        gc.freeze()
        begun_ns = time.monotonic_ns()
        for number, image in enumerate(_images(frames)):
            due_ns = begun_ns + round(number * 1e9 / options.rate)
            if due_ns - begun_ns > options.seconds * 1e9:
                break
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            now_ns = time.monotonic_ns()
            frame = Frame(number, due_ns, now_ns, 0, image, ())
            frontend.measure(frame, inference.start(frame))
            inference.over()
            if number >= WARM_UP_FRAMES:
                step_ms.append((time.monotonic_ns() - now_ns) / 1e6)
    gc.unfreeze()
    return {"step": step_ms}


def _images(frames: list[Frame]) -> Iterator[NDArray[np.uint8]]:
    """To the end and back again, so that the drive has no jump."""
    images = [cast(NDArray[np.uint8], frame.image) for frame in frames]
    return itertools.cycle(images + images[-2:0:-1])


def _row(parts: Parts) -> dict[str, Any]:
    frames_ms = np.sum(list(parts.values()), axis=0)
    return {
        "total_ms": spread(frames_ms),
        "parts_ms": {name: spread(values) for name, values in parts.items()},
        "curve_ms": curve(frames_ms),
        "noise": noise("total_ms", frames_ms),
    }


def _summary(row: dict[str, Any]) -> str:
    parts = "  ".join(f"{name} {part['p50']:.2f}" for name, part in row["parts_ms"].items() if part["n"])
    return f"{spread_text(row['total_ms'], 'ms')}  ({parts})"
