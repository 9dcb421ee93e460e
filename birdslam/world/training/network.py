"""The multi-task network: an encoder of plain 3x3 convolutions, a feature pyramid, and a head per task.

Plain convolutions are faster than depthwise ones on CPUs at equal accuracy, and gain from int8.
"""

from __future__ import annotations

import msgspec
from torch import Tensor, nn
from torch.nn import functional

from birdslam.perception.decoding.multitask import BODY_CHANNELS, CLASSES, OUTPUTS


class NetworkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Channels and convolutions of each resolution."""

    widths: tuple[int, ...] = (16, 32, 64, 96, 160)
    depths: tuple[int, ...] = (1, 2, 2, 3, 2)
    pyramid: int = 48
    context: int = 2  # blocks on the coarsest grid
    context_width: int = 96  # channels within such a block
    fine: int = 16  # channels at half the image's size


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _Context(nn.Module):
    """Adds global context to each cell, such as camera height and direction of the street.

    Without it the receptive field of the coarsest grid is less than half of the image. Initialized to zero output.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.narrow = _convolution(channels, width)
        self.wide = nn.Conv2d(width, channels, 3, 1, 2, dilation=2, bias=False)
        self.norm = nn.BatchNorm2d(channels)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.norm(self.wide(self.narrow(x))))


class _Fine(nn.Module):
    """Refines borders at half the image's size, from the pyramid and the encoder's first grid.

    Its output is added to the masks' logits and to log depth. Initialized to zero output.
    """

    def __init__(self, neck: int, first: int, width: int, answers: int) -> None:
        super().__init__()
        self.meaning = nn.Conv2d(neck, 4 * width, 1)
        self.detail = nn.Conv2d(first, width, 1, bias=False)
        self.mix = _convolution(width, width)
        self.say = nn.Conv2d(width, answers, 1, bias=False)
        nn.init.zeros_(self.say.weight)

    def forward(self, merged: Tensor, first: Tensor) -> Tensor:
        said: Tensor = self.say(self.mix(functional.pixel_shuffle(self.meaning(merged), 2) + self.detail(first)))
        return said


class MultiTask(nn.Module):
    """(B, 3, H, W) BGR in [-1, 1] -> `OUTPUTS`: see `perception.multitask` for what the channels mean.

    Segmentation and depth come at half the input's size, heat and bodies at a quarter. H and W divide by 32.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        channels, stages = 3, []
        for width, depth in zip(config.widths, config.depths, strict=True):
            blocks = [_convolution(channels if i == 0 else width, width, 2 if i == 0 else 1) for i in range(depth)]
            stages.append(nn.Sequential(*blocks))
            channels = width
        self.encoder = nn.ModuleList(stages)
        self.context = nn.Sequential(*[_Context(channels, config.context_width) for _ in range(config.context)])
        self.lateral = nn.ModuleList([nn.Conv2d(width, config.pyramid, 1) for width in config.widths[1:]])
        self.smooth = nn.ModuleList([_convolution(config.pyramid, config.pyramid) for _ in config.widths[1:-1]])
        neck = config.pyramid
        self.segmentation = nn.Sequential(_convolution(neck, neck), nn.Conv2d(neck, 2 * 4, 1))
        self.depth = nn.Sequential(_convolution(neck, neck), nn.Conv2d(neck, 4, 1))
        self.fine = _Fine(neck, config.widths[0], config.fine, 2 + 1)
        self.heat = nn.Sequential(_convolution(neck, neck), nn.Conv2d(neck, len(CLASSES), 1))
        self.body = nn.Sequential(_convolution(neck, neck), nn.Conv2d(neck, sum(BODY_CHANNELS.values()), 1))
        nn.init.constant_(self.heat[-1].bias, -4.0)  # centres are rare
        nn.init.constant_(self.depth[-1].bias, 2.7)  # log of 15 m

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Logits of the masks, log depth, logits of the centres, bodies."""
        levels = []
        x = image
        for stage in self.encoder:
            x = stage(x)
            levels.append(x)
        levels[-1] = self.context(levels[-1])
        merged = self.lateral[-1](levels[-1])
        for level in range(len(self.smooth) - 1, -1, -1):
            up = functional.interpolate(merged, scale_factor=2.0, mode="nearest")
            merged = self.smooth[level](self.lateral[level](levels[level + 1]) + up)
        fine = self.fine(merged, levels[0])
        return (
            functional.pixel_shuffle(self.segmentation(merged), 2) + fine[:, :2],
            functional.pixel_shuffle(self.depth(merged), 2) + fine[:, 2:],
            self.heat(merged),
            self.body(merged),
        )


assert len(OUTPUTS) == 4
