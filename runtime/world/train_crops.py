"""`python -m birdslam.runtime.world.train_crops`: trains the network that reads size and heading from vehicles' images.

Renders frames of the built-in world for a time or up to a number, then trains on crops of their vehicles. What was
rendered is kept and not rendered again. Needs the extra [train]; a graphics card is used where there is one.
"""

from __future__ import annotations

import argparse
import copy
import csv
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from birdslam.perception.crops import WINDOW
from birdslam.runtime.process.workers import workers
from birdslam.world.training.vehicle_crops import CropNet, CropsConfig, augmented, crops_of, loss, to_onnx

SIZES = ((1242, 375), (1280, 720), (960, 540), (1226, 370), (848, 480))  # of the frames
HELD_OUT = 20_000_000  # worlds from this seed on are never trained on
FRAMES_A_TASK = 8
BATCH = 1024
LEARNING_RATE = 3e-3


def rendered(first_seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Crops and targets of FRAMES_A_TASK frames, each of its own world."""
    from birdslam.world.world import sample

    images, targets = [], []
    for seed in range(first_seed, first_seed + FRAMES_A_TASK):
        rng = np.random.default_rng([seed, 7])
        examples = crops_of(sample(seed, *SIZES[seed % len(SIZES)]), CropsConfig(), rng)
        images.append(examples.image)
        targets.append(examples.target)
    return np.concatenate(images), np.concatenate(targets)


def gather(
    seeds: Sequence[int], seconds: float, processes: int
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    """The vehicles of the worlds from each of `seeds` on, of as many as are rendered when the time is over."""
    until_s = time.monotonic() + seconds
    with workers(processes) as pool:
        yield from _until(pool.map(rendered, seeds), until_s)
        pool.shutdown(wait=False, cancel_futures=True)


def _until(
    parts: Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]], until_s: float
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    for part in parts:
        yield part
        if time.monotonic() > until_s:
            return


def odds(target: NDArray[np.float32]) -> NDArray[np.float64]:
    """How often each example is drawn: a rare heading or kind more often than it comes, by the root of its count."""
    bins = np.floor((target[:, 3] + np.pi) / (2.0 * np.pi) * 36.0).astype(int) % 36
    cells = bins * 4 + target[:, 4].astype(int)
    count = np.bincount(cells, minlength=144)[cells]
    out: NDArray[np.float64] = 1.0 / np.sqrt(count)
    return out / out.sum()


def train(
    data: tuple[NDArray[np.uint8], NDArray[np.float32]],
    held: tuple[NDArray[np.uint8], NDArray[np.float32]],
    widths: Sequence[int],
    steps: int,
    seconds: float,
    seed: int,
    output: Path,
) -> CropNet:
    """The mean of the weights over the last steps (an exponential one), after `steps` or when the time is over."""
    torch.manual_seed(seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    spare = CropsConfig().spare_rel
    images, targets = torch.from_numpy(data[0]).to(device), torch.from_numpy(data[1]).to(device)
    weights = torch.from_numpy(odds(data[1])).to(device)
    batch = min(BATCH, len(images))
    network = CropNet(widths).to(device)
    average = copy.deepcopy(network).eval()
    optimiser = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=1e-2)
    started_s, step = time.monotonic(), 0
    output.parent.mkdir(parents=True, exist_ok=True)
    with output.with_suffix(".csv").open("w", newline="") as file:
        table = csv.writer(file)
        while True:
            # The rate falls with the share of the steps or of the time that is used, whichever is more
            share = max(step / steps, (time.monotonic() - started_s) / seconds)
            if share >= 1.0:
                break
            rate = LEARNING_RATE * min(1.0, (step + 1) / 200) * 0.5 * (1.0 + np.cos(np.pi * share)) + 1e-6
            for group in optimiser.param_groups:
                group["lr"] = rate
            rows = torch.multinomial(weights, batch, replacement=True)
            with torch.no_grad():
                x, y = augmented(images[rows], targets[rows], spare)
            network.train()
            with torch.autocast(device.type, torch.bfloat16):
                out = network(x)
            parts = loss(out, y)
            total = torch.stack(list(parts.values())).sum()
            optimiser.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            with torch.no_grad():
                keep = min(0.999, step / (step + 10.0))
                for old, new in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
                    if old.is_floating_point():
                        old.lerp_(new, 1.0 - keep)
                    else:
                        old.copy_(new)
            step += 1
            if step % 500 == 0 or step == steps:
                row = [step, round(time.monotonic() - started_s, 1), *_graded(average, held, spare, device)]
                table.writerow(row)
                file.flush()
                print(*row, f"{total.item():.3f}", flush=True)
                output.write_bytes(to_onnx(average))
    return average.cpu()


@torch.no_grad()
def _graded(
    network: CropNet,
    held: tuple[NDArray[np.uint8], NDArray[np.float32]],
    spare: float,
    device: torch.device,
) -> list[float]:
    """Of held-out worlds: loss, sd of the logs of length and height, median error of the axis (deg), ends swapped."""
    h, w = held[0].shape[1:3]
    top, left = (h - round(h / (1.0 + spare))) // 2, (w - round(w / (1.0 + spare))) // 2
    x = torch.from_numpy(held[0][:, top : h - top, left : w - left]).to(device).permute(0, 3, 1, 2).float()
    x = functional.interpolate(x, size=(WINDOW[1], WINDOW[0]), mode="bilinear") / 127.5 - 1.0
    y = torch.from_numpy(held[1]).to(device)
    out = torch.cat([network(part) for part in x.split(2048)])
    total = float(sum(loss(out, y).values()))
    error = (out[:, :3] - y[:, :3]).std(dim=0)
    axis = 0.5 * torch.atan2(out[:, 7], out[:, 6])
    off = torch.rad2deg(torch.remainder(axis - y[:, 3] + np.pi / 2, np.pi) - np.pi / 2).abs()
    logit = out[:, 8] * torch.cos(y[:, 3]) + out[:, 9] * torch.sin(y[:, 3])
    return [
        round(v, 4)
        for v in (total, float(error[0]), float(error[2]), float(off.median()), float((logit < 0).float().mean()))
    ]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m birdslam.runtime.world.train_crops", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--render-seconds", type=float, default=36_000.0, metavar="S")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--train-seconds", type=float, default=36_000.0, metavar="S")
    parser.add_argument("--widths", type=int, nargs="+", default=[24, 48, 72, 96])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--examples", type=Path, default=Path("out/train/crops.npz"), help="what was rendered")
    parser.add_argument("--output", type=Path, default=Path("out/train/vehicle.onnx"))
    args = parser.parse_args()
    if args.examples.exists():
        with np.load(args.examples) as file:
            data, held = (file["image"], file["target"]), (file["held_image"], file["held_target"])
    else:
        held_seeds = range(HELD_OUT, HELD_OUT + args.frames // 20, FRAMES_A_TASK)
        seeds = range(args.seed * 1_000_000, args.seed * 1_000_000 + args.frames, FRAMES_A_TASK)
        parts = list(gather([*held_seeds, *seeds], args.render_seconds, args.processes))
        held, data = (
            (np.concatenate([part[0] for part in some]), np.concatenate([part[1] for part in some]))
            for some in (parts[: len(held_seeds)], parts[len(held_seeds) :])
        )
        args.examples.parent.mkdir(parents=True, exist_ok=True)
        np.savez(args.examples, image=data[0], target=data[1], held_image=held[0], held_target=held[1])
    print(f"{len(data[0])} vehicles, {len(held[0])} held out", flush=True)
    network = train(data, held, args.widths, args.steps, args.train_seconds, args.seed, args.output)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_bytes(to_onnx(network))
    print(f"{args.output}: {args.output.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
