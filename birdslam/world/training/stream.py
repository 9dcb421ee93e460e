"""An endless stream of training examples from a seed: rendered frames, each used more than once.

Rendering a small frame takes longer than a training step. So each frame of a pool gives several examples with different
windows and augmentations; the pool is renewed frame by frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats32
from birdslam.world.training.augmentation import AugmentationConfig, draw_window, photometric
from birdslam.world.training.targets import Example, TargetsConfig, encode
from birdslam.world.truth import WorldFrame

Render = Callable[[int, int, int], WorldFrame]  # (seed, width_px, height_px), as `rendered_world.world.sample`

HELD_OUT_SEEDS = 1_000_000  # lower seeds are for evaluation, this and higher ones for training


class StreamConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the stream."""

    width_px: int = 640
    height_px: int = 192
    looks: int = 2  # mean number of examples per rendered frame
    pool_frames: int = 500
    batch: int = 16
    targets: TargetsConfig = TargetsConfig()
    augmentation: AugmentationConfig = AugmentationConfig()


@dataclass(frozen=True)
class Examples:
    """B examples, stacked; see `targets.Example`."""

    image: NDArray[np.uint8]
    masks: Floats32
    log_depth: Floats32
    sky: Bools
    objects: Floats32


def examples(seed: int, config: StreamConfig, render: Render) -> Iterator[Examples]:
    """Endless batches, deterministic by seed."""
    rng = np.random.default_rng(seed)
    pool: list[WorldFrame] = []
    owed = 0.0
    while True:
        batch = []
        for _ in range(config.batch):
            owed += 1.0 / config.looks
            if owed >= 1.0 or not pool:
                owed = max(0.0, owed - 1.0)
                frame = render(int(rng.integers(HELD_OUT_SEEDS, 2**62)), config.width_px, config.height_px)
                if len(pool) < config.pool_frames:
                    pool.append(frame)
                else:
                    pool[int(rng.integers(len(pool)))] = frame
            else:
                frame = pool[int(rng.integers(len(pool)))]
            batch.append(draw_example(frame, config, rng))
        yield stack(batch)


def draw_example(frame: WorldFrame, config: StreamConfig, rng: np.random.Generator) -> Example:
    """A random window of a frame with random augmentation."""
    height_px, width_px = frame.image.shape[:2]
    window = draw_window(width_px, height_px, config.augmentation, rng)
    example = encode(frame, window, config.width_px, config.height_px, config.targets)
    image = photometric(example.image, config.augmentation, rng)
    return Example(image, example.masks, example.log_depth, example.sky, example.objects)


def stack(batch: list[Example]) -> Examples:
    """Stacks examples to one array per field."""
    return Examples(
        np.stack([example.image for example in batch]),
        np.stack([example.masks for example in batch]),
        np.stack([example.log_depth for example in batch]),
        np.stack([example.sky for example in batch]),
        np.stack([example.objects for example in batch]),
    )
