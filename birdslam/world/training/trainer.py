"""Training steps of the multi-task network, its optimizer and its moving average, with a state for checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from birdslam.geometry.arrays import Floats32
from birdslam.perception.decoding.multitask import OUTPUTS, body_slices
from birdslam.world.training.losses import Batch, LossConfig, loss
from birdslam.world.training.network import MultiTask, NetworkConfig
from birdslam.world.training.stream import Examples


class TrainerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the optimizer."""

    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig()
    weight_decay: float = 0.01
    warm_up_steps: int = 200
    rate_end: float = 0.02  # of the stage's learning rate, at its end
    clip: float = 5.0  # norm of the gradient
    average: float = 0.998  # weight of the old average at each step


class Trainer:
    """Holds the network in training and its moving average, which is exported."""

    def __init__(self, config: TrainerConfig, half: bool) -> None:
        """`half`: use bfloat16 where it is safe."""
        self.config = config
        self.half = half
        self.network = MultiTask(config.network).to(memory_format=torch.channels_last)
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.average), use_buffers=True)
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        free = [p for p in self.network.parameters() if p.ndim <= 1]
        self.optimiser = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": config.weight_decay}, {"params": free, "weight_decay": 0.0}], lr=1e-3
        )

    def train_step(
        self,
        examples: tuple[Tensor, ...],
        progress: float,
        step: int,
        rate: float,
        share: Callable[[Sequence[Parameter]], None] | None = None,
    ) -> dict[str, float]:
        """One step on a batch; `progress` is in [0, 1], `rate` the stage's learning rate. Returns the loss parts.

        `share` averages the gradients of several parallel trainers.
        """
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(progress, 1.0)))
        warm = min(1.0, (step + 1) / self.config.warm_up_steps)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * warm * (self.config.rate_end + (1.0 - self.config.rate_end) * cosine)
        self.network.train()
        batch = as_batch(examples)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            outputs = self.network(batch.image)
        parts = loss(outputs, batch, self.config.loss)
        total = torch.stack(list(parts.values())).sum()
        self.optimiser.zero_grad()
        total.backward()
        if share is not None:
            share([p for p in self.network.parameters() if p.grad is not None])
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        if bool(torch.isfinite(norm)):
            self.optimiser.step()
            self.average.update_parameters(self.network)
        costs = {"total": total, **parts, "norm": norm}
        return {name: float(cost.detach()) for name, cost in costs.items()}

    def enlarge(self, factor: float) -> None:
        """Adapts the depth to inputs `factor` times as wide: an object of the same size in pixels is farther away."""
        shift = math.log(factor)
        with torch.no_grad():
            for network in (self.network, self.average.module):
                network.depth[-1].bias += shift
                network.body[-1].bias[body_slices()["log_depth"]] += shift

    def state(self) -> dict[str, Any]:
        """The state for `load`."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restores a state."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])

    @torch.no_grad()
    def raw_outputs(self, image: Floats32) -> dict[str, Floats32]:
        """Outputs by name of the averaged network for images (B, 3, H, W) in [-1, 1]."""
        self.average.eval()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            outputs = self.average(torch.from_numpy(image))
        return {name: output.float().numpy() for name, output in zip(OUTPUTS, outputs, strict=True)}


def as_tensors(examples: Examples) -> tuple[Tensor, ...]:
    """Examples as tensors, to be sent between processes."""
    arrays = (examples.image, examples.masks, examples.log_depth, examples.sky, examples.objects)
    return tuple(torch.from_numpy(array) for array in arrays)


def as_batch(tensors: tuple[Tensor, ...]) -> Batch:
    """A batch with the image normalized for the network."""
    image, masks, log_depth, sky, objects = tensors
    return Batch(image.permute(0, 3, 1, 2).float() / 127.5 - 1.0, masks, log_depth, sky, objects)
