"""Results of the ego-motion of a film: valid frames, time of the first, speed relative to the truth; table and plot."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from birdslam.types import Status

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TrueSpeed = Callable[[float, float], float]  # m/s between two times in s of the recording

BEGINNING_S = 2.0  # time after which estimates should be valid
ALIKE = 0.03  # max. relative difference of distance between variants of one film
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


def course_of_run(path: Path, true_mps: TrueSpeed) -> Course:
    """Reads the frames.csv of `birdslam run`."""
    course = Course()
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for before, row in itertools.pairwise(rows):
        if row["speed_mps"]:
            t_s, end_s = float(before["t_s"]), float(row["t_s"])
            at_s = end_s - float(rows[0]["t_s"])
            valid, stands = row["valid"] == "1", Status.STANDSTILL.value in row["status"].split()
            speed_mps, sigma_rel = float(row["speed_mps"]), float(row["scale_sigma_rel"])
            course.add(at_s, end_s - t_s, speed_mps, true_mps(t_s, end_s), valid, sigma_rel, stands)
    return course


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


def page(rows: list[dict[str, Any]]) -> str:
    """The rows as a page with a table per part."""
    lines = [
        "# Variants of films",
        "",
        "Consistency of the scale of each recording at other sizes and rates, with H.264, with obstructions, and with",
        "later starts (`python -m perf films`). Valid frames and speed count after the first 2 s; *over* is the ratio",
        "of speed to that of the unchanged film, the median over seconds; *deviation* is the median absolute deviation",
        "of the ratio of speed to truth. `town`: the truth is GPS at 1 Hz, in whole km/h; its lens is unknown, so a",
        "constant factor is due to its focal length and height. `town_72` uses the field of view that matches GPS",
        "instead of the stated 60 degrees. For `rain` only bounds of the speed are known, 15 to 35 m/s. *Beyond* are",
        "seconds with a distance error over two stated sigma, including the camera's; *standstill* are images with",
        "this status while the car moves, *outside* valid ones with an impossible speed. All variants of a film use",
        "one camera file (`perf/film_cameras`). *Noise* adds noise of 1.5 grey levels to each pixel: smaller",
        "differences between variants are not significant.",
    ]
    for part in dict.fromkeys(row["part"] for row in rows):
        chosen = [row for row in rows if row["part"] == part]
        lines += [
            *("", f"## {part.capitalize()}", "", *_spread(chosen)),
            "| film | valid after 2 s | first valid, s | speed over truth | deviation | over | beyond, s | standstill |"
            " outside |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        lines += [
            (
                f"| {row['name']} | {row['valid_after_2_s']:.0%} | {_text(row['first_valid_s'], '.2f')} | "
                f"{_text(row['speed_over_truth'], '.3f')} | {_text(row['deviation'], '.1%')} | "
                f"{_text(row['way_over_unchanged'], '.3f')} | {row['beyond_s']} | {row['standstill']} | "
                f"{row['outside']} |"
            )
            for row in chosen
        ]
    return "\n".join(lines) + "\n"


def _spread(rows: list[dict[str, Any]]) -> list[str]:
    """For each film the range of its variants relative to the unchanged one."""
    out = []
    for film in dict.fromkeys(row["film"] for row in rows):
        ratios = [row["way_over_unchanged"] for row in rows if row["film"] == film]
        known = [ratio for ratio in ratios if ratio is not None]
        if not known:
            continue
        inside = sum(abs(ratio - 1.0) <= ALIKE for ratio in known)
        out.append(f"- {film}: {min(known):.3f} to {max(known):.3f}, {inside} of {len(ratios)} within {ALIKE:.0%}")
    return [*out, ""] if out else []


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws speed over truth by seconds, a panel per part and film."""
    panels = list(dict.fromkeys((row["film"], row["part"]) for row in rows))
    figure, axes = plt.subplots(len(panels), 1, figsize=(10, 2.6 * len(panels)), squeeze=False)
    for (film, part), panel in zip(panels, axes[:, 0], strict=True):
        for row in rows:
            if (row["film"], row["part"]) == (film, part):
                ratio = [np.nan if value is None else value for value in row["by_second"]]
                name = row["name"].partition(": ")[2]
                panel.plot(np.arange(len(ratio)) + 0.5, ratio, marker=".", label=name, linewidth=1)
        panel.set(title=f"{film}: {part}", xlabel="s", ylabel="speed over truth", ylim=(0.5, 1.6))
        panel.legend(fontsize=6, ncols=3)
        panel.grid(True, alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)
