"""The loss of the multi-task network: depth, masks, class heat maps, and the body of each cell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import torch
from torch import Tensor
from torch.nn import functional

from birdslam.perception.decoding.multitask import CLASSES, MEAN_SIZE_M, body_slices
from birdslam.world.training.targets import COLUMN

_BODY = body_slices()
MAX_EXP = 1.0  # of log depth; a larger error has a linear cost


class LossConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Weights of the parts, which make them comparable."""

    depth: float = 4.0
    sky: float = 0.1
    shape: float = 0.5  # of the depth's error about its mean over the image
    relative: float = 0.5  # of the depth's error over the truth; the rest is of its logarithm
    road: float = 1.5
    lane: float = 1.3
    overlap: float = 0.5  # of a mask, by Dice
    heat: float = 1.0
    box: float = 2.0
    kind: float = 0.3
    offset: float = 0.3
    body_depth: float = 0.7
    size: float = 1.0
    axis: float = 0.6
    front: float = 1.0
    spread: float = 0.54  # of a box: its heat's reach, in sixths of its extent
    hot: float = 0.2  # min. heat of a cell that predicts the object's body


@dataclass(frozen=True)
class Batch:
    """B examples as tensors; see `targets.Example`. `image` (B, 3, H, W) float in [-1, 1]."""

    image: Tensor
    masks: Tensor
    log_depth: Tensor
    sky: Tensor
    objects: Tensor


def loss(outputs: tuple[Tensor, ...], batch: Batch, config: LossConfig) -> dict[str, Tensor]:
    """The weighted parts of the loss; minimize their sum."""
    segmentation, log_depth, heat, body = (output.float() for output in outputs)
    cells = _Cells(batch, heat.shape[2], heat.shape[3], config)
    return {
        **depth_loss(log_depth[:, 0], batch, config),
        **_masks(segmentation, batch.masks, config),
        "heat": config.heat * _focal(heat, cells),
        **_bodies(body, cells, config),
    }


def von_mises(axis: Tensor, angle_rad: Tensor, max_kappa: float = math.inf) -> Tensor:
    """Negative log likelihood (N,) of angles modulo pi; `axis` (N, 2) is cos and sin of twice the angle, times kappa.

    The concentration kappa is limited to `max_kappa`. I0 is scaled to avoid overflow.
    """
    length = torch.sqrt(axis.square().sum(dim=1) + 1e-6)
    concentration = length.clamp(max=max_kappa)
    along = axis[:, 0] * torch.cos(2.0 * angle_rad) + axis[:, 1] * torch.sin(2.0 * angle_rad)
    return concentration - along * concentration / length + torch.log(torch.special.i0e(concentration))


def depth_loss(log_depth: Tensor, batch: Batch, config: LossConfig) -> dict[str, Tensor]:
    """Parts of the loss of log depth (images, rows, columns), by name."""
    weight = torch.where(batch.sky, config.sky, 1.0)
    error = log_depth - batch.log_depth
    total = weight.sum(dim=(1, 2))
    mean = (weight * error).sum(dim=(1, 2), keepdim=True) / total[:, None, None]
    # On an outline either depth may be true: a logarithmic error favours the more likely depth, a relative error the
    # nearer one. The relative error has a bounded derivative, so that a pole in front of the sky does not dominate.
    over = torch.expm1(error.clamp(0.0, MAX_EXP)) + math.exp(MAX_EXP) * (error - MAX_EXP).clamp(min=0.0)
    missed = over - torch.expm1(error.clamp(max=0.0))
    blame = config.relative * missed + (1.0 - config.relative) * error.abs()
    absolute = (weight * blame).sum(dim=(1, 2)) / total
    shape = (weight * (error - mean).abs()).sum(dim=(1, 2)) / total
    return {"depth": config.depth * (absolute.mean() + config.shape * shape.mean())}


def _masks(logits: Tensor, truth: Tensor, config: LossConfig) -> dict[str, Tensor]:
    out = {}
    for index, (name, weight) in enumerate((("road", config.road), ("lane", config.lane))):
        logit, share = logits[:, index], truth[:, index]
        entropy = functional.binary_cross_entropy_with_logits(logit, share)
        # Markings cover few pixels: a factor makes their cross entropy comparable to the road's
        entropy = entropy * (1.0 if name == "road" else 5.0)
        guess = torch.sigmoid(logit)
        common = (guess * share).sum(dim=(1, 2))
        dice = 1.0 - (2.0 * common + 1.0) / (guess.square().sum(dim=(1, 2)) + share.square().sum(dim=(1, 2)) + 1.0)
        out[name] = weight * (entropy + config.overlap * dice.mean())
    return out


class _Cells:
    """Targets of the grid cells: the heat of each class, the object whose body a cell predicts, and its weight."""

    def __init__(self, batch: Batch, rows: int, columns: int, config: LossConfig) -> None:
        objects = batch.objects
        self.cell_px = batch.image.shape[3] / columns
        x1, y1, x2, y2 = (objects[..., COLUMN[name]] / self.cell_px for name in ("x1_px", "y1_px", "x2_px", "y2_px"))
        self.x = torch.arange(columns, dtype=torch.float32) + 0.5
        self.y = torch.arange(rows, dtype=torch.float32) + 0.5
        centre_x = (0.5 * (x1 + x2)).floor().clamp(0, columns - 1) + 0.5
        centre_y = (0.5 * (y1 + y2)).floor().clamp(0, rows - 1) + 0.5
        sigma_x = (config.spread * (x2 - x1) / 6.0).clamp(min=0.4)
        sigma_y = (config.spread * (y2 - y1) / 6.0).clamp(min=0.4)
        across = torch.exp(-0.5 * ((self.x - centre_x[..., None]) / sigma_x[..., None]).square())
        down = torch.exp(-0.5 * ((self.y - centre_y[..., None]) / sigma_y[..., None]).square())
        taught = objects[..., COLUMN["taught"]] > 0.0
        across = across * taught[..., None]
        present = (x2 - x1) > 0.0
        inside_x = (self.x >= x1[..., None]) & (self.x <= x2[..., None])
        inside_y = (self.y >= y1[..., None]) & (self.y <= y2[..., None])
        unclear = (present & ~taught).float()
        self.ignored = torch.einsum("bm,bmy,bmx->byx", unclear, inside_y.float(), inside_x.float()) > 0.0
        heat = down[..., :, None] * across[..., None, :]  # (B, M, rows, columns)
        classes = objects[..., COLUMN["class"]].long()
        self.heat = torch.stack(
            [(heat * (classes == index)[..., None, None]).amax(dim=1) for index in range(len(CLASSES))], dim=1
        )
        self.peak = torch.stack(
            [((heat > 0.999) & (classes == index)[..., None, None]).any(dim=1) for index in range(len(CLASSES))], dim=1
        )
        hottest, owner = heat.max(dim=1)
        # The cells that predict a body: (n,) image, row, column, and (n, columns) of its object
        self.b, self.j, self.i = torch.nonzero(hottest > config.hot, as_tuple=True)
        self.owner = objects[self.b, owner[self.b, self.j, self.i]]
        weight = hottest[self.b, self.j, self.i]
        # The weight of an object is the log of its extent, independent of its number of cells
        share = torch.zeros(objects.shape[:2])
        share.index_put_((self.b, owner[self.b, self.j, self.i]), weight, accumulate=True)
        self.objects = max(int(taught.sum()), 1)
        self.weight = weight / share[self.b, owner[self.b, self.j, self.i]]


def _focal(logits: Tensor, cells: _Cells) -> Tensor:
    """CenterNet's penalty-reduced focal loss."""
    score = torch.sigmoid(logits).clamp(1e-6, 1.0 - 1e-6)
    hit = torch.where(cells.peak, (1.0 - score).square() * torch.log(score), 0.0)
    false = torch.where(cells.peak, 0.0, (1.0 - cells.heat) ** 4 * score.square() * torch.log(1.0 - score))
    false = false * ~cells.ignored[:, None]
    return -(hit.sum() + false.sum()) / cells.objects


def _bodies(body: Tensor, cells: _Cells, config: LossConfig) -> dict[str, Tensor]:
    said = body[cells.b, :, cells.j, cells.i]  # (n, channels)
    truth, weight = cells.owner, cells.weight / cells.objects
    x, y = cells.x[cells.i], cells.y[cells.j]

    def of(*names: str) -> Tensor:
        return truth[:, [COLUMN[name] for name in names]]

    def total(error: Tensor, mask: Tensor | None = None) -> Tensor:
        return (error * weight * (1.0 if mask is None else mask)).sum()

    vehicle = (truth[:, COLUMN["class"]] == 0.0).float()
    box = of("x1_px", "y1_px", "x2_px", "y2_px") / cells.cell_px
    sides = torch.exp(said[:, _BODY["sides"]].clamp(-4.0, 6.0))
    here = torch.stack([x, y], dim=1)
    guess = torch.cat([here - sides[:, :2], here + sides[:, 2:]], dim=1)
    extent = torch.cat([box[:, 2:] - box[:, :2]] * 2, dim=1).clamp(min=1.0)
    edges = ((guess - box).abs() / extent).sum(dim=1)
    kind = functional.cross_entropy(said[:, _BODY["kind"]], truth[:, COLUMN["kind"]].long(), reduction="none")
    offset = of("u_px", "v_px") / cells.cell_px - here
    aside = (said[:, _BODY["offset"]] - offset).abs().sum(dim=1) / extent[:, 2:].amax(dim=1)
    log_sigma = said[:, _BODY["log_sigma"]][:, 0].clamp(-4.0, 2.0)
    depth_error = (said[:, _BODY["log_depth"]][:, 0] - truth[:, COLUMN["log_depth"]]).abs()
    laplace = depth_error * torch.exp(-log_sigma) + log_sigma
    size = of("log_length", "log_width", "log_height") - torch.log(torch.tensor(MEAN_SIZE_M))
    size_error = (said[:, _BODY["log_size"]] - size).abs().sum(dim=1)
    sin, cos = of("sin_alpha", "cos_alpha").T
    axis, front = said[:, _BODY["axis"]], said[:, _BODY["front"]]
    mises = von_mises(axis, torch.atan2(sin, cos))
    which = functional.softplus(-(front[:, 0] * cos + front[:, 1] * sin)) + 0.002 * front.square().sum(dim=1)
    return {
        "box": config.box * (total(edges) + total(1.0 - _giou(guess, box))),
        "kind": config.kind * total(kind, vehicle),
        "offset": config.offset * total(aside),
        "body_depth": config.body_depth * (total(laplace) + total(depth_error)),
        "size": config.size * total(size_error),
        "axis": config.axis * total(mises, vehicle),
        "front": config.front * total(which, vehicle),
    }


def _giou(a: Tensor, b: Tensor) -> Tensor:
    """Generalized IoU (n,) of pairs of boxes."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    common = (high - low).clamp(min=0.0).prod(dim=1)
    union = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1) - common
    hull = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).prod(dim=1)
    return common / union.clamp(min=1e-6) - (hull - union) / hull.clamp(min=1e-6)
