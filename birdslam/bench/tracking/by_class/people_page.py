"""docs/people.md and docs/cyclists.md: what `birdslam evaluate localisation ROOT --class KIND` left, as tables."""

from __future__ import annotations

import msgspec

from birdslam.bench.figures import markdown, number
from birdslam.bench.tracking.by_class.class_tracks import TracksRow
from birdslam.bench.tracking.by_class.people import PeopleRow


class PeopleReport(msgspec.Struct, frozen=True):
    """report.json."""

    places: list[PeopleRow]
    tracks: list[TracksRow]


_CHOSEN = (
    "Sequences 0002, 0013, 0016 and 0017 chose constants of the filter ([constants.md](constants.md)); in 0016 and "
    "0017 the ego stands. Walking: the median error of the velocity of who walks, and its parts away from the camera "
    "and across; standing: the median speed reported of who stands."
)
_BOXES = {
    "pedestrian": "Boxes of people are those that RRC recorded.",
    "cyclist": "No boxes of riders were recorded: the labels' outlines stand in, with the noise of real boxes.",
}


def pedestrians(text: str) -> str:
    """docs/people.md of report.json."""
    return _page("Pedestrians", "people", "pedestrian", text)


def cyclists(text: str) -> str:
    """docs/cyclists.md of report.json."""
    return _page("Cyclists", "cyclists", "cyclist", text)


def _page(title: str, name: str, kind: str, text: str) -> str:
    report = msgspec.json.decode(text, type=PeopleReport)
    places = [
        [
            *(row.sequence, row.range, str(row.n)),
            *(_percent(row.depth_error_median_rel, 1), _percent(row.depth_bias_median_rel, 1)),
            number(row.lateral_error_median_m),
            *(_percent(row.inside_1_sigma), _percent(row.inside_2_sigma)),
            *(number(row.walking_speed_error_median_mps), number(row.walking_along_ray_median_mps)),
            *(number(row.walking_across_ray_median_mps), number(row.standing_speed_median_mps)),
        ]
        for row in report.places
        if row.n
    ]
    tracks = [
        [
            *(row.sequence, row.view, str(row.labels)),
            *(f"{of:.3f}" for of in (row.hota, row.det_a, row.ass_a, row.loc_a, row.idf1, row.mota)),
            f"{row.switches_per_minute:.1f}",
        ]
        for row in report.tracks
    ]
    head = ["sequence", "range m", "n", "depth error", "bias", "across m", "inside 1 sigma", "2 sigma"]
    return "\n".join(
        [
            f"# {title}: places, speeds and tracks",
            "",
            f"Written by `python -m perf pages --write {name}`. {_BOXES[kind]} {_CHOSEN}",
            "",
            markdown([*head, "walking m/s", "away", "across", "standing m/s"], places),
            "Tracks in bird's-eye view (within 2 m) and in the image (IoU of 0.5):",
            "",
            markdown(
                ["sequence", "view", "labels", *("HOTA", "DetA", "AssA", "LocA", "IDF1", "MOTA"), "switches a minute"],
                tracks,
            ),
        ]
    )


def _percent(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{100.0 * value:.{digits}f} %"
