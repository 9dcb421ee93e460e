"""docs/constants.md's table of what other sequences choose, made of docs/results/leave_one_out.json."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from statistics import fmean

import msgspec

from birdslam.bench.tracking.leave_one_out import LeftOut
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.machine import ROOT
from birdslam.runtime.pages.tables import table

PAGE, KEPT = "docs/constants.md", "docs/results/leave_one_out.json"
TRIED = {  # half and twice of each, all others as they are; of the gate 1.5 and 3
    **{"localisation.sigma_box_rel": (0.01, 0.04), "localisation.sigma_box_px": (0.2, 0.8)},
    **{"localisation.sigma_hidden_rel": (0.0125, 0.05), "localisation.shape_floor_m": (0.01, 0.04)},
    **{"tracking.parallax.side_outlier": (0.015, 0.06), "tracking.parallax.sigma_side_outlier_rel": (0.15, 0.6)},
    **{"ground_size.sigma_pitch_rad": (0.005, 0.02), "ground_size.sigma_pitch_step_rad": (0.0004, 0.0016)},
    **{"ground_size.sigma_roll_rad": (0.01, 0.04), "ground_size.sigma_edge_rel": (0.011, 0.044)},
    **{"ground_size.sigma_kerb_m": (0.009, 0.036), "ground_size.sigma_crown_rad": (0.0019, 0.0076)},
    **{"ground_size.sigma_tilt_rad": (0.0008, 0.003), "ground_size.sigma_common_crown_rad": (0.006, 0.024)},
    **{"tracking.heading.oblique": (0.05, 0.2), "localisation.vehicles.car.height_m": (1.47, 1.53)},
    **{"ground_size.box_memory_s": (0.25, 1.0), "ground_size.gate_sigma": (1.5, 3.0)},
    **{"ground_size.driving_mps": (0.5, 2.0), "ground_size.bend_per_m": (0.0025, 0.01)},
}
OPTIONS = " ".join(f"--leave-one-out slam.frontend.{key}={low},{high}" for key, (low, high) in TRIED.items())
HEAD = (
    *("constant", "as it is", "chosen by the others (sequences)", "score as it is", "chosen", "better, worse"),
    *("depth error as it is", "chosen"),
)


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A constant over all sequences: means, and what the others chose for how many of them."""

    key: str
    as_it_is: str
    chosen: dict[str, int]
    score_as_it_is: float
    score_chosen: float
    better: int
    worse: int
    depth_error_as_it_is_rel: float
    depth_error_chosen_rel: float


def kept(report: str) -> str:
    """The text of what is kept of a report, leave_one_out.json."""
    every = msgspec.json.decode(report, type=list[LeftOut])
    rows = [_row([row for row in every if row.key == key]) for key in dict.fromkeys(row.key for row in every)]
    return json.dumps(msgspec.to_builtins(rows), indent=1) + "\n"


def _row(rows: Sequence[LeftOut]) -> Row:
    return Row(
        key=rows[0].key,
        as_it_is=rows[0].as_it_is,
        chosen=dict(Counter(row.chosen for row in rows).most_common()),
        score_as_it_is=round(fmean(row.score_as_it_is for row in rows), 5),
        score_chosen=round(fmean(row.score_chosen for row in rows), 5),
        better=sum(row.score_chosen < row.score_as_it_is for row in rows),
        worse=sum(row.score_chosen > row.score_as_it_is for row in rows),
        depth_error_as_it_is_rel=round(fmean(row.depth_error_as_it_is_rel for row in rows), 6),
        depth_error_chosen_rel=round(fmean(row.depth_error_chosen_rel for row in rows), 6),
    )


def texts() -> dict[str, str]:
    """The page with the table as it is to be. Raises PerfError where it has none."""
    text, kept = ((ROOT / file).read_text(encoding="utf-8") for file in (PAGE, KEPT))
    made = _table(msgspec.json.decode(kept, type=list[Row]))
    head = re.escape(f"| {' | '.join(HEAD)} |")
    new, tables = re.subn(rf"^{head}\n(?:\|.*\n)+", lambda _: f"{made}\n", text, flags=re.MULTILINE)
    if tables != 1:
        raise PerfError(f"{PAGE} has {tables} tables of what the others chose, not one")
    return {PAGE: new}


def _table(rows: Sequence[Row]) -> str:
    body = [
        (
            f"`{row.key}`",
            row.as_it_is,
            ", ".join(f"{value} ({times})" for value, times in row.chosen.items()),
            *(f"{score:.3f}" for score in (row.score_as_it_is, row.score_chosen)),
            f"{row.better}, {row.worse}",
            *(
                f"{error:.2%}".replace("%", " %")
                for error in (row.depth_error_as_it_is_rel, row.depth_error_chosen_rel)
            ),
        )
        for row in rows
    ]
    return table([HEAD, *body])
