"""`make train`: trains the shipped network from a seed, on rendered worlds. Needs the extra [train].

    python -m birdslam.runtime.world.train --output out/train [--config FILE.toml]

The output has `curves.csv` (each part of the loss), `grades.csv` (held-out worlds), `checkpoint.pt`, and
`multitask.onnx` with its manifest. The same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import torch
from torch import distributed
from torch.utils.data import DataLoader, IterableDataset

from birdslam.perception.manifest import MultiTask
from birdslam.world.training.export import manifest, to_onnx
from birdslam.world.training.stream import StreamConfig, examples
from birdslam.world.training.trainer import Trainer, TrainerConfig, as_tensors
from birdslam.world.training.validation import validate
from birdslam.world.truth import WorldFrame

NAME = "multitask"
ABSREL_TO_SIGMA = (0.5 * np.pi) ** 0.5  # sigma over mean absolute error of a normal distribution


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the training at one image size."""

    width_px: int
    height_px: int
    batch: int  # per process
    steps: int
    rate: float  # initial learning rate
    looks: int  # examples per rendered frame


class TrainConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A training: small images first, which are four times as fast, then the image size of the network."""

    seed: int = 1
    stages: tuple[Stage, ...] = (
        Stage(width_px=320, height_px=96, batch=16, steps=4000, rate=2e-3, looks=3),
        Stage(width_px=640, height_px=192, batch=6, steps=12000, rate=1.2e-3, looks=3),
    )
    stream: StreamConfig = StreamConfig()
    trainer: TrainerConfig = TrainerConfig()
    processes: int = 3  # data-parallel training processes
    workers: int = 1  # rendering workers per process; 0: the process renders
    threads: int = 1
    half: bool | None = None  # bfloat16; None: if the processor supports it
    held_out_frames: int = 96
    final_frames: int = 300  # held-out frames for the metrics in the manifest
    row_steps: int = 50  # between rows of curves.csv
    grade_steps: int = 1000


class Worlds(IterableDataset[tuple[torch.Tensor, ...]]):
    """The stream of examples, different for each worker."""

    def __init__(self, seed: tuple[int, ...], config: StreamConfig) -> None:
        self.seed, self.config = seed, config

    def __iter__(self) -> Iterator[tuple[torch.Tensor, ...]]:
        info = torch.utils.data.get_worker_info()
        seeds = np.random.SeedSequence([*self.seed, 0 if info is None else info.id])
        seed = int(seeds.generate_state(1, np.uint64)[0])
        for batch in examples(seed, self.config, _render):
            yield as_tensors(batch)


def _render(seed: int, width_px: int, height_px: int) -> WorldFrame:
    from birdslam.world.world import sample  # imported late because it compiles kernels

    return sample(seed, width_px, height_px)


def _average_gradients(parameters: Sequence[torch.nn.Parameter]) -> None:
    """Replaces each gradient by its mean over all processes."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    distributed.all_reduce(flat)
    flat /= distributed.get_world_size()
    for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


_WEIGHTS = "teacher"  # key of the trainer state in a checkpoint; kept to read older checkpoints


class Training:
    """One training run with its output directory."""

    def __init__(self, config: TrainConfig, output: Path, rank: int) -> None:
        self.config, self.output, self.rank = config, output, rank
        torch.manual_seed(config.seed)
        torch.set_num_threads(config.threads)
        cv2.setNumThreads(config.threads)
        half = torch.ops.mkldnn._is_mkldnn_bf16_supported() if config.half is None else config.half
        self.trainer = Trainer(config.trainer, bool(half))
        self.stage, self.step = 0, 0
        checkpoint = output / "checkpoint.pt"
        if checkpoint.exists():
            state = torch.load(checkpoint, weights_only=True)
            self.trainer.load(state[_WEIGHTS])
            self.stage, self.step = state["stage"], state["step"]

    def run(self) -> None:
        """Runs the remaining stages from the step of the checkpoint."""
        while self.stage < len(self.config.stages):
            self._learn(self.config.stages[self.stage], self.stage)
            if self.stage + 1 < len(self.config.stages):
                stage, following = self.config.stages[self.stage : self.stage + 2]
                self.trainer.enlarge(following.width_px / stage.width_px)
            self.stage, self.step = self.stage + 1, 0
            self._save()
        if self.rank == 0:
            self._export(self._grade(self.config.stages[-1], self.stage, self.config.final_frames))

    def _learn(self, stage: Stage, number: int) -> None:
        stream = msgspec.structs.replace(
            self.config.stream, width_px=stage.width_px, height_px=stage.height_px, batch=stage.batch, looks=stage.looks
        )
        worlds = Worlds((self.config.seed, number, self.step, self.rank), stream)
        loader = DataLoader(
            worlds,
            batch_size=None,
            num_workers=self.config.workers,
            prefetch_factor=8 if self.config.workers else None,
            worker_init_fn=_one_thread,
            multiprocessing_context="spawn" if self.config.workers else None,
        )
        sums: dict[str, float] = {}
        begun_s, waited_s = time.monotonic(), 0.0
        batches = iter(loader)
        while self.step < stage.steps:
            asked_s = time.monotonic()
            batch = next(batches)
            waited_s += time.monotonic() - asked_s
            share = _average_gradients if self.config.processes > 1 else None
            parts = self.trainer.train_step(batch, self.step / stage.steps, self.step, stage.rate, share)
            for name, value in parts.items():
                sums[name] = sums.get(name, 0.0) + value / self.config.row_steps
            self.step += 1
            if self.rank > 0:
                continue  # only rank 0 writes curves and checkpoints
            if self.step % self.config.row_steps == 0:
                spent_s = time.monotonic() - begun_s
                row = {"stage": number, "step": self.step, "seconds": spent_s, "waited": waited_s, **sums}
                _append(self.output / "curves.csv", row)
                speed = self.config.row_steps * stage.batch * self.config.processes / spent_s
                print(f"stage {number} step {self.step}: {sums['total']:.3f}  {speed:.0f} images/s", flush=True)
                sums, begun_s, waited_s = {}, time.monotonic(), 0.0
            if self.step % self.config.grade_steps == 0 or self.step == stage.steps:
                self._save()
                self._export(self._grade(stage, number, self.config.held_out_frames))
                begun_s = time.monotonic()

    def _save(self) -> None:
        """Writes a checkpoint atomically."""
        if self.rank > 0:
            return
        state = {_WEIGHTS: self.trainer.state(), "stage": self.stage, "step": self.step}
        partial = self.output / "checkpoint.part"
        torch.save(state, partial)
        partial.replace(self.output / "checkpoint.pt")

    def _grade(self, stage: Stage, number: int, frames: int) -> dict[str, float]:
        """Evaluates the averaged network on held-out worlds; returns metrics and thresholds, appends to grades.csv."""
        size_px = (stage.width_px, stage.height_px)
        rng = np.random.default_rng([self.config.seed, number])
        figures = validate(self.trainer.raw_outputs, _render, size_px, frames, self.config.stream.augmentation, rng)
        _append(self.output / "grades.csv", {"stage": number, "step": self.step, **figures})
        print("  ".join(f"{name} {value:.3f}" for name, value in figures.items()), flush=True)
        return figures

    def _export(self, figures: Mapping[str, float]) -> None:
        """Writes the averaged network as ONNX with a manifest of its metrics, atomically."""
        network = self.trainer.average.module
        size_px = (self.config.stages[-1].width_px, self.config.stages[-1].height_px)
        content = to_onnx(network, *size_px)
        score = figures["vehicle_score"] if np.isfinite(figures["vehicle_score"]) else MultiTask().score_threshold
        text = manifest(
            title="BirdSLAM multi-task",
            parameters=sum(p.numel() for p in network.parameters()),
            sha256=hashlib.sha256(content).hexdigest(),
            size_px=size_px,
            score=score,
            lane_logit=figures["lane_logit"],
            depth_sigma_rel=ABSREL_TO_SIGMA * figures["depth_absrel"],
        )
        write_network(self.output, content, text)


def write_network(folder: Path, content: bytes, text: str, name: str = NAME) -> None:
    """Writes a network and its manifest to a folder, atomically."""
    for suffix, data in ((".onnx", content), (".toml", text.encode())):
        partial = folder / f"{name}{suffix}.part"
        partial.write_bytes(data)
        partial.replace(folder / f"{name}{suffix}")


def _append(path: Path, row: Mapping[str, Any]) -> None:
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow({key: f"{value:.5g}" if isinstance(value, float) else value for key, value in row.items()})


def _learn(rank: int, config: TrainConfig, output: Path, meeting: str | None) -> None:
    """Runs one training process."""
    if meeting is not None:
        distributed.init_process_group("gloo", init_method=meeting, rank=rank, world_size=config.processes)
    Training(config, output, rank).run()
    if meeting is not None:
        distributed.destroy_process_group()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m birdslam.runtime.world.train", description="train the shipped network"
    )
    parser.add_argument("--output", type=Path, default=Path("out/train"))
    parser.add_argument("--config", type=Path, help="TOML file of differences from the defaults")
    options = parser.parse_args(arguments)
    os.environ["NUMBA_NUM_THREADS"] = "1"  # the workers run in parallel
    config = TrainConfig()
    if options.config is not None:
        config = msgspec.toml.decode(options.config.read_bytes(), type=TrainConfig)
    options.output.mkdir(parents=True, exist_ok=True)
    if config.processes == 1:
        _learn(0, config, options.output, None)
    else:
        with tempfile.TemporaryDirectory(prefix="train") as folder:
            meeting = f"file://{folder}/meeting"
            torch.multiprocessing.spawn(_learn, (config, options.output, meeting), nprocs=config.processes)


if __name__ == "__main__":
    main()
