"""`python -m birdslam.runtime.world.train_lanes`: trains the lane completion (ENet) on drives of the built-in world.

One seed determines worlds, shuffling and initial weights. Needs the extra [train].
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from birdslam.lanes.amodal.lanes import LanesConfig
from birdslam.perception.completion import SHIPPED
from birdslam.runtime.process.workers import workers
from birdslam.world.training.lanes import ENet, LaneSamplesConfig, loss, samples

DRIVE_FRAMES, RATE_HZ = 60, 10.0
HELD_OUT = 10_000_000  # first seed of the held-out worlds
BATCH = 32
LEARNING_RATE = 2e-3


def drive_samples(seed: int) -> NDArray[np.uint8]:
    """Returns observed and true grids of the drive in one world, (N, 2, 2, rows, columns) of 0..255."""
    from birdslam.world.world import World, WorldConfig

    torch.set_num_threads(1)
    frames = World(seed, WorldConfig(width_px=480, height_px=144, samples=1)).frames(DRIVE_FRAMES, RATE_HZ)
    pairs = [
        np.stack(pair) for pair in samples(frames, np.random.default_rng(seed), LanesConfig(), LaneSamplesConfig())
    ]
    return np.round(np.array(pairs) * 255.0).astype(np.uint8)


def drives(first_seed: int, count: int, processes: int) -> Iterator[NDArray[np.uint8]]:
    """Yields the samples of `count` worlds in the order of their seeds."""
    with workers(processes) as pool:
        yield from pool.map(drive_samples, range(first_seed, first_seed + count))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m birdslam.runtime.world.train_lanes", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drives", type=int, default=120)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--output", type=Path, default=SHIPPED)
    parser.add_argument("--curve", type=Path, default=Path("out/train/lanes.csv"))
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads)
    rng = np.random.default_rng(args.seed)

    parts = []
    for index, part in enumerate(drives(args.seed, args.drives, args.processes)):
        parts.append(part)
        if index % 20 == 19:
            print(f"rendered {index + 1} of {args.drives} drives", flush=True)
    pairs = np.concatenate(parts)
    del parts
    held_out = np.concatenate(list(drives(HELD_OUT, 12, args.processes)))

    network = ENet()
    steps = args.epochs * (len(pairs) // BATCH)
    optimiser = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=steps)
    args.curve.parent.mkdir(parents=True, exist_ok=True)
    with args.curve.open("w", newline="") as file:
        curve = csv.writer(file)
        curve.writerow(["epoch", "seconds", "loss", "held_out_loss"])
        started_s = time.monotonic()
        for epoch in range(args.epochs):
            network.train()
            total = 0.0
            order = rng.permutation(len(pairs))[: len(pairs) // BATCH * BATCH].reshape(-1, BATCH)
            for rows in order:
                batch = pairs[np.sort(rows)]
                if rng.random() < 0.5:  # mirrored
                    batch = batch[..., ::-1]
                value = loss(*_run(network, batch))
                optimiser.zero_grad()
                value.backward()
                optimiser.step()
                schedule.step()
                total += value.item()
            network.eval()
            with torch.no_grad():
                held = np.mean([loss(*_run(network, part)).item() for part in np.array_split(held_out, 8)])
            row = [epoch, round(time.monotonic() - started_s), round(total / len(order), 4), round(float(held), 4)]
            curve.writerow(row)
            file.flush()
            print(*row, flush=True)
    export(network, args.output)
    print(f"{args.output}: {args.output.stat().st_size} bytes")
    return 0


def _run(network: ENet, batch: NDArray[np.uint8]) -> tuple[torch.Tensor, torch.Tensor]:
    pair = torch.from_numpy(np.ascontiguousarray(batch)).float() / 255.0
    with torch.autocast("cpu", torch.bfloat16):
        logits = network(pair[:, 0].contiguous())
    return logits.float(), pair[:, 1]


def export(network: ENet, path: Path) -> None:
    """Writes the network with its sigmoid as ONNX, for one pair of grids."""
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = torch.nn.Sequential(network, torch.nn.Sigmoid()).eval()
    torch.onnx.export(
        whole,
        (torch.zeros(1, 2, *LanesConfig().shape),),
        str(path),
        input_names=["grids"],
        output_names=["completed"],
        opset_version=17,
        dynamo=False,
    )


if __name__ == "__main__":
    sys.exit(main())
