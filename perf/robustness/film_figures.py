"""Results of the ego-motion of a film: valid frames, time of the first, speed relative to the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

TrueSpeed = Callable[[float, float], float]  # m/s between two times in s of the recording

BEGINNING_S = 2.0  # time after which estimates should be valid
MIN_SPEED_MPS = 1.0  # below it a ratio of speeds is meaningless


class Step(NamedTuple):
    """A motion of a variant: its end and duration, speed and true speed, and whether it is valid."""

    t_s: float
    lasts_s: float
    speed_mps: float
    true_mps: float
    valid: bool
    sigma_rel: float  # 1-sigma of its length, including the camera's
    stands: bool = False  # whether it reports standstill


def summary(steps: Sequence[Step]) -> dict[str, Any]:
    """The results of a row."""
    t_s, _, speed_mps, true_mps, valid, sigma_rel, stands = _columns(steps)
    ratio = speed_mps / np.maximum(true_mps, 0.1)
    late = t_s > BEGINNING_S
    counted = valid & late & (true_mps > MIN_SPEED_MPS)
    median = float(np.median(ratio[counted])) if counted.any() else None
    return {
        "frames": len(t_s),
        "valid": float(valid.mean()) if len(valid) else 0.0,
        "valid_after_2_s": float(valid[late].mean()) if late.any() else 0.0,
        "first_valid_s": float(t_s[valid.argmax()]) if valid.any() else None,
        "speed_over_truth": median,
        "deviation": None if median is None else float(np.median(np.abs(ratio[counted] / median - 1.0))),
        "sigma_rel": float(np.median(sigma_rel[counted])) if counted.any() else None,
        "by_second": (by_second := _by_second(steps)),
        "beyond_s": _beyond_s(steps, by_second),
        "standstill": int((stands & (true_mps > MIN_SPEED_MPS)).sum()),
    }


def _columns(steps: Sequence[Step]) -> tuple[Any, ...]:
    """An array per field of the steps."""
    columns = np.array(steps, np.float64).reshape(-1, len(Step._fields)).T
    return tuple(
        column > 0.0 if name in ("valid", "stands") else column
        for name, column in zip(Step._fields, columns, strict=True)
    )


def _by_second(steps: Sequence[Step]) -> list[float | None]:
    """Ratio of estimated to true distance of the valid motions of each second.

    Ratios of distances rather than frames: KITTI's true steps are uneven, so a median over frames depends on the rate.
    """
    t_s, lasts_s, speed_mps, true_mps, valid, *_ = _columns(steps)
    out: list[float | None] = []
    for second in range(int(t_s[-1]) + 1 if len(t_s) else 0):
        here = valid & (t_s >= second) & (t_s < second + 1)
        true_m = float((true_mps * lasts_s)[here].sum())
        out.append(round(float((speed_mps * lasts_s)[here].sum()) / true_m, 3) if true_m > 0.1 else None)
    return out


def _beyond_s(steps: Sequence[Step], by_second: Sequence[float | None]) -> int:
    """Number of seconds with a distance error over two sigma."""
    beyond = 0
    for second, ratio in enumerate(by_second):
        sigmas = [step.sigma_rel for step in steps if step.valid and second <= step.t_s < second + 1]
        beyond += ratio is not None and abs(np.log(max(ratio, 1e-3))) > 2.0 * float(np.median(sigmas))
    return beyond


def over(figures: dict[str, Any], unchanged: dict[str, Any]) -> float | None:
    """Ratio of distance to that of the unchanged film: median over the seconds in which both are valid."""
    both = [(a, b) for a, b in zip(figures["by_second"], unchanged["by_second"], strict=False) if a and b]
    return float(np.median([a / b for a, b in both])) if both else None


def row_text(figures: dict[str, Any]) -> str:
    """A row as text."""
    return (
        f"valid {figures['valid_after_2_s']:.0%} from {_text(figures['first_valid_s'], '.2f')} s on  speed over truth "
        f"{_text(figures['speed_over_truth'], '.3f')} +- {_text(figures['deviation'], '.1%')}  over the unchanged "
        f"{_text(figures.get('way_over_unchanged'), '.3f')}  by seconds "
        + " ".join(_text(ratio, ".2f") for ratio in figures["by_second"])
        + f"  {figures['beyond_s']} s beyond 2 sigma  standstill {figures['standstill']}"
    )


def _text(figure: float | None, form: str) -> str:
    return "-" if figure is None else format(figure, form)
