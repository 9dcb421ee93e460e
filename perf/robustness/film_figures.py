"""Results of the ego-motion of a film: valid frames, time of the first, speed relative to the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

TrueSpeed = Callable[[float, float], float]  # m/s between two times in s of the recording

BEGINNING_S = 2.0  # time after which estimates should be valid
MIN_SPEED_MPS = 1.0  # below it a ratio of speeds is meaningless


@dataclass
class Course:
    """The motions of a variant: end and duration (s), speed and true speed (m/s), validity.

    `sigma_rel` is the relative 1-sigma of its length, including the camera's; `stands` whether it reports standstill.
    """

    t_s: list[float] = field(default_factory=list)
    lasts_s: list[float] = field(default_factory=list)
    speed_mps: list[float] = field(default_factory=list)
    true_mps: list[float] = field(default_factory=list)
    valid: list[bool] = field(default_factory=list)
    sigma_rel: list[float] = field(default_factory=list)
    stands: list[bool] = field(default_factory=list)

    def add(
        self,
        t_s: float,
        lasts_s: float,
        speed_mps: float,
        true_mps: float,
        valid: bool,
        sigma_rel: float,
        stands: bool = False,
    ) -> None:
        """Adds a motion."""
        self.t_s.append(t_s)
        self.lasts_s.append(lasts_s)
        self.speed_mps.append(speed_mps)
        self.true_mps.append(true_mps)
        self.valid.append(valid)
        self.sigma_rel.append(sigma_rel)
        self.stands.append(stands)


def summary(course: Course, between_mps: tuple[float, float] = (0.0, np.inf)) -> dict[str, Any]:
    """The results of a row; `between_mps` are the bounds of the true speed."""
    t_s, valid, true_mps = np.array(course.t_s), np.array(course.valid, bool), np.array(course.true_mps)
    speed_mps = np.array(course.speed_mps)
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
        "sigma_rel": float(np.median(np.array(course.sigma_rel)[counted])) if counted.any() else None,
        "by_second": _by_second(course),
        "beyond_s": _beyond_s(course),
        "standstill": int((np.array(course.stands, bool) & (true_mps > MIN_SPEED_MPS)).sum()),
        "outside": int((valid & ((speed_mps < between_mps[0]) | (speed_mps > between_mps[1]))).sum()),
    }


def _by_second(course: Course) -> list[float | None]:
    """Ratio of estimated to true distance of the valid motions of each second.

    Ratios of distances rather than frames: KITTI's true steps are uneven, so a median over frames depends on the rate.
    """
    t_s, lasts_s, valid = np.array(course.t_s), np.array(course.lasts_s), np.array(course.valid, bool)
    way_m, true_m = np.array(course.speed_mps) * lasts_s, np.array(course.true_mps) * lasts_s
    out: list[float | None] = []
    for second in range(int(t_s[-1]) + 1 if len(t_s) else 0):
        here = valid & (t_s >= second) & (t_s < second + 1)
        true = float(true_m[here].sum())
        out.append(round(float(way_m[here].sum()) / true, 3) if true > 0.1 else None)
    return out


def _beyond_s(course: Course) -> int:
    """Number of seconds with a distance error over two sigma."""
    t_s, valid, sigma_rel = np.array(course.t_s), np.array(course.valid, bool), np.array(course.sigma_rel)
    beyond = 0
    for second, ratio in enumerate(_by_second(course)):
        here = valid & (t_s >= second) & (t_s < second + 1)
        beyond += ratio is not None and abs(np.log(max(ratio, 1e-3))) > 2.0 * float(np.median(sigma_rel[here]))
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
        + f"  {figures['beyond_s']} s beyond 2 sigma  standstill {figures['standstill']}  outside {figures['outside']}"
    )


def _text(figure: float | None, form: str) -> str:
    return "-" if figure is None else format(figure, form)
