"""`python -m birdslam.runtime.world.train_pointnet`: trains the Frustum-PointNet on bodies of the built-in world.

    python -m birdslam.runtime.world.train_pointnet --output out/train/pointnet [--ship]

One seed determines worlds, noise, order and initial weights. The output has the curve and the network. Needs the extra
[train].
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from birdslam.perception.manifest import SHIPPED_NETWORKS
from birdslam.runtime.process.workers import workers
from birdslam.world.training.pointnet import (
    POINTS,
    DepthErrorConfig,
    FrustumConfig,
    FrustumExample,
    PointNet,
    frusta_of,
    loss,
    manifest,
    to_onnx,
    training_pair,
)

NAME = "pointnet"
MAP_PX = (320, 96)  # size of the depth map of the shipped multi-task network
FIRST_SEED = 2_000_000  # worlds with lower seeds are for evaluation
HELD_OUT_SEED = 1_000
BATCH = 128
LEARNING_RATE = 2e-3
FEW_POINTS = 192  # per body until the last two epochs, for speed
WORLDS_PER_TASK = 100


def render(first_seed: int) -> list[FrustumExample]:
    """Returns the bodies of `WORLDS_PER_TASK` independent frames."""
    from birdslam.world.world import sample  # imported late because it compiles kernels

    config = FrustumConfig()
    frames = (sample(seed, *MAP_PX) for seed in range(first_seed, first_seed + WORLDS_PER_TASK))
    return [example for frame in frames for example in frusta_of(frame, config)]


def rendered(first_seed: int, frames: int, processes: int) -> list[FrustumExample]:
    """Returns the bodies of `frames` frames in the order of their seeds."""
    out: list[FrustumExample] = []
    with workers(processes) as pool:
        for part in pool.map(render, range(first_seed, first_seed + frames, WORLDS_PER_TASK)):
            out += part
            print(f"\r{len(out)} bodies", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return out


def batches(
    examples: Sequence[FrustumExample], rng: np.random.Generator, points: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yields batches of all examples in random order, each with random depth errors and a random subset of points."""
    config, features, targets = DepthErrorConfig(), [], []
    for index in rng.permutation(len(examples)):
        one = training_pair(examples[index], config, rng)
        if one is not None:
            features.append(one[0] if points == POINTS.count else one[0][:, rng.permutation(POINTS.count)[:points]])
            targets.append(one[1])
        if len(features) == BATCH:
            yield torch.from_numpy(np.stack(features)), torch.from_numpy(np.stack(targets))
            features, targets = [], []


def learn(
    examples: Sequence[FrustumExample], held_out: Sequence[FrustumExample], epochs: int, seed: int, curve: Path
) -> PointNet:
    """Trains a network on the examples; writes a row per epoch."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = PointNet()
    half = bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    steps = epochs * (len(examples) // BATCH + 1)
    optimiser = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps, pct_start=0.1)
    start_s = time.monotonic()
    with curve.open("w", newline="") as file:
        rows = csv.writer(file)
        for epoch in range(epochs):
            network.train()
            for features, targets in batches(examples, rng, FEW_POINTS if epoch < epochs - 2 else POINTS.count):
                optimiser.zero_grad()
                with torch.autocast("cpu", torch.bfloat16, enabled=half):
                    out = network(features)
                sum(loss(out, targets).values(), torch.zeros(())).backward()
                torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
                optimiser.step()
                schedule.step()
            parts = validated(network, held_out)
            if not epoch:
                rows.writerow(["epoch", "seconds", *parts])
            spent_s = time.monotonic() - start_s
            rows.writerow([epoch, f"{spent_s:.0f}", *(f"{value:.4f}" for value in parts.values())])
            file.flush()
            losses = "  ".join(f"{name} {value:.3f}" for name, value in parts.items())
            print(f"epoch {epoch}  {spent_s:.0f} s  {losses}", flush=True)
    return network


def validated(network: PointNet, held_out: Sequence[FrustumExample]) -> dict[str, float]:
    """Returns the mean losses on held-out bodies."""
    network.eval()
    sums: dict[str, float] = {}
    count = 0
    with torch.no_grad():
        for features, targets in batches(held_out, np.random.default_rng(0), POINTS.count):
            for name, value in loss(network(features), targets).items():
                sums[name] = sums.get(name, 0.0) + float(value)
            count += 1
    return {name: value / max(count, 1) for name, value in sums.items()}


def write(network: PointNet, directory: Path) -> None:
    """Writes the network and its manifest."""
    content = to_onnx(network)
    (directory / f"{NAME}.onnx").write_bytes(content)
    parameters = sum(p.numel() for p in network.parameters())
    text = manifest(parameters, hashlib.sha256(content).hexdigest())
    (directory / f"{NAME}.toml").write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m birdslam.runtime.world.train_pointnet", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=8000, help="number of frames, each of another world")
    parser.add_argument("--epochs", type=int, default=16)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("out/train/pointnet"))
    parser.add_argument("--ship", action="store_true", help="put the network into the package")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    options.output.mkdir(parents=True, exist_ok=True)
    held_out = rendered(HELD_OUT_SEED, 500, options.processes)
    examples = rendered(FIRST_SEED + options.seed * 10_000_000, options.frames, options.processes)
    network = learn(examples, held_out, options.epochs, options.seed, options.output / "curve.csv")
    for directory in (options.output, *([SHIPPED_NETWORKS] if options.ship else [])):
        write(network, directory)
    return 0


if __name__ == "__main__":
    sys.exit(main())
