"""Constants that data chose: their page is what the code has, and leaving a sequence out chooses by the others."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from birdslam.bench.simulation.odometry import OdometryNoise
from birdslam.bench.tracking.leave_one_out import left_out, score
from birdslam.bench.tracking.localisation import CarError
from birdslam.frontend import FrontEndConfig
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.localisation import read_sweep
from birdslam.runtime.fields import fields
from birdslam.runtime.pages.tables import comments
from birdslam.slam import SlamConfig

PAGE = Path(__file__).parent.parent / "docs" / "constants.md"
ROWS = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text(), re.MULTILINE)
RECORDINGS = re.compile(r"KITTI|\b00[01]\d\b|raw clip|motorway clip|shipped drive")


def in_code(name: str) -> object:
    """A key of the method's defaults, or what stands in a module."""
    value: object
    if name.startswith("slam."):
        value, parts = SlamConfig(), name.split(".")[1:]
    else:
        words = name.split(".")
        at = next(k for k in range(len(words)) if not words[k].islower())
        value, parts = importlib.import_module(".".join(words[:at])), words[at:]
    for part in parts:
        value = value[part] if isinstance(value, dict) else getattr(value, part)
        value = value() if isinstance(value, type) else value
    return value


@pytest.mark.parametrize(("name", "stated"), [(name, stated.strip()) for name, stated, *_ in ROWS])
def test_a_constant_is_what_the_page_says(name: str, stated: str) -> None:
    value = in_code(name)
    if stated == "fitted":
        assert value == OdometryNoise()
    elif isinstance(value, msgspec.Struct):
        assert [float(number) for number in stated.split(",")] == list(msgspec.structs.astuple(value)[:3])
    else:
        assert value == float(stated)


def test_every_key_that_names_a_recording_is_on_the_page() -> None:
    names = {name for name, *_ in ROWS}
    assert len(names) == len(ROWS) > 20
    found = list(fields(SlamConfig, SlamConfig(), "slam."))
    assert {f.key for f in found if RECORDINGS.search(comments(f.struct).get(f.name, ""))} <= names


def test_the_page_says_of_the_papers_tables_what_its_rows_say() -> None:
    """What the eleven sequences chose, 0010 and 0018 chose: the row of Tables 1-5 names each."""
    (tables,) = re.findall(r"^\| Tables 1-5 \| .*$", PAGE.read_text(), re.MULTILINE)
    chosen = [name.split(".")[-1] for name, _, data, _ in ROWS if "the eleven sequences" in data]
    assert len(chosen) == 7
    assert [name for name in chosen if f"`{name}`" not in tables] == []


# --- leaving one sequence out ---


def cars(sequence: str, error_m: float, sigma_m: float, n: int = 4) -> list[CarError]:
    return [
        CarError(
            sequence=sequence,
            frame=k,
            label=0,
            depth_m=20.0,
            error_m=np.array([error_m, 0.0]),
            mahalanobis2=(error_m / sigma_m) ** 2,
            log_det_cov=4.0 * float(np.log(sigma_m)),
            yaw_error_rad=0.0,
        )
        for k in range(n)
    ]


def test_the_best_sigma_is_that_of_the_errors() -> None:
    """Of two degrees of freedom: 2 sigma^2 = e^2."""
    scores = {sigma: score(cars("a", 1.0, sigma)) for sigma in (0.3, 0.5, 0.5**0.5, 1.0, 2.0)}
    assert min(scores, key=lambda sigma: scores[sigma]) == 0.5**0.5


def test_a_sequence_does_not_choose_for_itself() -> None:
    """Two sequences want a small sigma and one a large one: each is judged by what the other two want."""
    wants = {"a": 0.1, "b": 0.1, "c": 1.0}
    found = {value: {name: cars(name, e, float(value)) for name, e in wants.items()} for value in ("0.1", "1.0")}
    rows = {row.sequence: row for row in left_out("key", "0.1", found)}
    assert (rows["c"].chosen, rows["c"].as_it_is) == ("0.1", "0.1")
    assert rows["c"].score_chosen == rows["c"].score_as_it_is
    assert rows["a"].chosen == rows["b"].chosen == "1.0"  # c errs by ten of their sigmas
    assert rows["a"].score_chosen > rows["a"].score_as_it_is
    assert rows["a"].depth_error_chosen_rel == pytest.approx(0.1 / 20.0)


def test_one_sequence_can_not_be_left_out() -> None:
    with pytest.raises(ValueError, match="2 are needed"):
        left_out("key", "1", {"1": {"a": cars("a", 1.0, 1.0), "b": []}})


def test_a_constant_to_choose_is_a_number_of_the_front_end() -> None:
    key, as_it_is, found = read_sweep("slam.frontend.ground_size.sigma_kerb_m=0.02,0.08", Configuration())
    assert (key, as_it_is, [*found]) == ("slam.frontend.ground_size.sigma_kerb_m", "0.018", ["0.018", "0.02", "0.08"])
    assert found["0.08"].ground_size.sigma_kerb_m == 0.08
    assert found["0.018"] == FrontEndConfig()
    for text in ("sigma_kerb_m=1", "slam.frontend.none=1", "slam.frontend.ground_size.cues=1", "slam.frontend.x"):
        with pytest.raises(ConfigurationError, match="--leave-one-out"):
            read_sweep(text, Configuration())
    with pytest.raises(ConfigurationError, match="wide"):
        read_sweep("slam.frontend.ground_size.sigma_kerb_m=wide", Configuration())
