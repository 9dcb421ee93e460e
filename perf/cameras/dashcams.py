"""Dashcams that nobody here has seen: drawn by seed, rendered, filmed, and driven with the camera file unknown.

    python -m perf dashcams [--seeds N ...] [--seconds S] [--films DIR] [--output DIR] [--networks] [--model ROLE=PATH]

Each seed draws a street with traffic, a light, and a dashcam: its lens (60 to 140 degrees across), distortion, height,
tilt, rolling shutter, exposure, size, rate, H.264 quality, and what is before it (bonnet, caption, wiper, drops, dirt,
a reflection). The film is driven as README says: `--height`, half of them with `--fov` as its box would say it, the
lens by `calibrate`. Rendering needs the extra `train` and PyAV; `--films` keeps films. Writes dashcams.json and .md.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.perception import ModelError
from birdslam.perf.accuracy import films
from birdslam.perf.accuracy.drives import networks_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.robustness.film_figures import row_text, summary
from birdslam.perf.robustness.film_variants import Variant
from birdslam.runtime.calibration.drive import ROUGH, calibrate_drive
from birdslam.runtime.calibration.given import Given
from birdslam.runtime.configuration import Configuration, load
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError

if TYPE_CHECKING:
    from birdslam.world.dashcam import Dashcam

label = "dashcams drawn by seed, with the camera file unknown: valid share, scale, wrong while valid"

SEEDS = tuple(range(1, 13))
SECONDS = 6.0
AHEAD_M = 1.6  # of a windscreen before the rear axle
_BEGIN_M = 300.0  # along the street
_HEIGHTS_M, _TILTS_RAD = (1.1, 1.7), (0.06, 0.03)
_READOUT_S, _DUSK_EXPOSURE_S, _LIGHT = (0.0, 0.03), (0.005, 0.02), (0.03, 0.3)  # by day an exposure is a millisecond
_WIDTHS_PX, _RATES_HZ, _CRF = (480, 640, 960), (10.0, 15.0, 20.0, 30.0), (18, 33)
_WIDEST_PINHOLE_DEG = 105.0  # wider lenses are equidistant
_MONOTONE = 0.2  # of k1 r^2 in the image's corner: a third would fold the image
# How often a film has what, by judgement
_STATES_FOV, _IS_DUSK = 0.5, 0.25
_SHARES = {"bonnet": 0.4, "caption": 0.5, "wiper": 0.15, "drops": 0.15, "drops_defocused": 0.1, "dirt": 0.1}
_SHARES |= {"reflection": 0.15}


@dataclass(frozen=True)
class Drawn:
    """A dashcam, its film's rate and quality, and what its owner knows of it; `shown` is before the lens."""

    dashcam: Dashcam
    rate_hz: float
    crf: int
    fov_deg: float | None
    shown: tuple[str, ...]

    @property
    def words(self) -> str:
        """The dashcam for a person."""
        cam = self.dashcam
        parts = [
            f"{cam.width_px}x{cam.height_px} {self.rate_hz:.0f} Hz crf {self.crf}",
            f"{cam.fov_deg:.0f} deg" + (" fisheye" if cam.fisheye else f" k1 {cam.k1:+.2f}"),
            f"h {cam.height_m:.2f} m",
            f"{1e3 * cam.readout_s:.0f} ms",
            *(["dusk"] if cam.light < 1.0 else []),
            *self.shown,
        ]
        return ", ".join(parts)


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("dashcams", label, output="folder of dashcams.json and dashcams.md")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, metavar="N")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each film")
    parser.add_argument("--films", type=Path, metavar="DIR", help="keep the films there, and take those that are there")
    add_networks(parser)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    configuration, output = networks_of(options), options.output
    path = None if output is None else output / "dashcams.json"
    try:
        with tempfile.TemporaryDirectory() as folder, Ledger(path, label, seconds=options.seconds) as ledger:
            for seed in options.seeds:
                row = measure(seed, options.seconds, options.films or Path(folder), configuration)
                ledger.add(f"{seed}: {row['dashcam']}", f"\n    {row['lens']}\n    {row_text(row)}", seed=seed, **row)
            ledger.set(total=total(ledger.content["rows"]))
            print(total_text(ledger.content["total"]))
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error
    if path is not None:
        (output / "dashcams.md").write_text(page(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(f"results in {output}")


def draw(seed: int) -> Drawn:
    """The dashcam of a seed. Raises PerfError where the built-in world is not installed."""
    windscreen, dashcam = _world()
    rng = np.random.default_rng([seed, 34])
    fov_deg = float(rng.uniform(60.0, 140.0))
    corner = math.tan(math.radians(0.5 * min(fov_deg, _WIDEST_PINHOLE_DEG))) * math.hypot(1.0, 9.0 / 16.0)
    k1 = -float(rng.uniform(0.0, min(0.3, _MONOTONE / corner**2)))
    width_px = int(rng.choice(_WIDTHS_PX))
    dusk = rng.random() < _IS_DUSK
    fisheye = fov_deg > _WIDEST_PINHOLE_DEG
    shown = tuple(name for name, share in _SHARES.items() if rng.random() < share)
    rate_hz = float(rng.choice(_RATES_HZ))
    edits = {
        "bonnet": lambda index, count, image: windscreen.bonnet(image),
        "caption": windscreen.caption,
        "wiper": windscreen.wiper(max(2, round(0.8 * rate_hz))),
    }
    cam = dashcam.Dashcam(
        width_px=width_px,
        height_px=2 * round(width_px * 9 / 32),
        fov_deg=fov_deg,
        k1=0.0 if fisheye else k1,
        fisheye=fisheye,
        height_m=float(rng.uniform(*_HEIGHTS_M)),
        pitch_rad=float(rng.uniform(-1.0, 1.0) * _TILTS_RAD[0]),
        roll_rad=float(rng.uniform(-1.0, 1.0) * _TILTS_RAD[1]),
        readout_s=float(rng.uniform(*_READOUT_S)),
        exposure_s=float(rng.uniform(*_DUSK_EXPOSURE_S)) if dusk else 0.0,
        adapts_s=0.5,
        light=float(rng.uniform(*_LIGHT)) if dusk else 1.0,
        glass=tuple(edits.get(name) or windscreen.from_share(name, seed, 0.0) for name in reversed(shown)),
    )
    states = rng.random() < _STATES_FOV
    return Drawn(cam, rate_hz, int(rng.integers(*_CRF)), round(fov_deg / 5.0) * 5.0 if states else None, shown)


def _world() -> tuple[Any, Any]:
    """The built-in world's modules of what is before a lens, and of dashcams."""
    try:
        from birdslam.world import dashcam, windscreen
    except ImportError as error:
        raise PerfError(f"rendering needs the extra `train` (pip install 'birdslam[train]'): {error}") from None
    return windscreen, dashcam


def render(seed: int, drawn: Drawn, seconds: float, path: Path) -> None:
    """The film of a seed, and beside it (.npz) where its camera was."""
    from dataclasses import replace

    from birdslam.world.dashcam import film, write_film
    from birdslam.world.scenario import draw_scenario

    scenario = replace(draw_scenario(np.random.default_rng([seed, 35]), "", _BEGIN_M), camera_ahead_m=AHEAD_M)
    poses: list[NDArray[np.float64]] = []

    def images() -> Iterator[NDArray[np.uint8]]:
        for frame in film(scenario, drawn.dashcam, round(seconds * drawn.rate_hz), drawn.rate_hz):
            poses.append(frame.T_world_cam)
            yield frame.image

    path.parent.mkdir(parents=True, exist_ok=True)
    write_film(path, images(), drawn.rate_hz, drawn.crf)
    np.savez_compressed(path.with_suffix(".npz"), T_world_cam=np.array(poses))


def measure(seed: int, seconds: float, folder: Path, configuration: Configuration | None) -> dict[str, Any]:
    """A row: the film of a seed, driven."""
    drawn, path = draw(seed), folder / f"dashcam_{seed}.mp4"
    if not path.with_suffix(".npz").is_file():
        render(seed, drawn, seconds, path)
    with np.load(path.with_suffix(".npz")) as kept:
        at_m = kept["T_world_cam"][:, :3, 3]
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at_m, axis=0), axis=1)))
    times_s = np.arange(len(way_m)) / drawn.rate_hz

    def true_mps(begin_s: float, end_s: float) -> float:
        return float(np.diff(np.interp([begin_s, end_s], times_s, way_m))[0] / (end_s - begin_s))

    given = Given(height_m=drawn.dashcam.height_m, fov_deg=drawn.fov_deg)
    found = calibrate_drive(load(None, {}), f"video:{path}", given, config=ROUGH, must_show=False)
    recording = open_recording(f"video:{path}", found.camera)
    span_s = 0.0, seconds
    course = films.drive(
        recording, Variant("unchanged"), span_s, true_mps, films.looks(recording, span_s, configuration)
    )
    stated = "--fov unknown" if drawn.fov_deg is None else f"--fov {drawn.fov_deg:.0f}"
    true = drawn.dashcam.camera
    sigma_rel = found.camera.scale_sigma_rel
    off, pitch_mrad = found.camera.fx_px / true.fx_px - 1.0, 1e3 * (found.camera.pitch_rad - true.pitch_rad)
    roll_mrad = 1e3 * (found.camera.roll_rad - true.roll_rad)
    return {
        "dashcam": drawn.words,
        "lens": f"{stated}: f {off:+.0%}, pitch {pitch_mrad:+.0f} and roll {roll_mrad:+.0f} mrad off, "
        f"lengths +- {sigma_rel:.0%}",
        "focal_over_true": found.camera.fx_px / true.fx_px,
        "speed_mps": float(way_m[-1] / times_s[-1]),
        **summary(course),
    }


def total(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Over all films: seconds valid, and of them those beyond two sigma."""
    late = [row["valid_after_2_s"] for row in rows]
    seconds = sum(value is not None for row in rows for value in row["by_second"])
    return {
        "films": len(rows),
        "valid_after_2_s": float(np.mean(late)),
        "nine_tenths": sum(share >= 0.9 for share in late),
        "seconds": seconds,
        "beyond_s": sum(row["beyond_s"] for row in rows),
        "standstill": sum(row["standstill"] for row in rows),
    }


def total_text(figures: dict[str, float]) -> str:
    """A line for a person."""
    return (
        f"{figures['films']} films: {figures['valid_after_2_s']:.0%} valid after 2 s, {figures['nine_tenths']} of them "
        f"at least 90 %; {figures['beyond_s']} of {figures['seconds']} s beyond 2 sigma, {figures['standstill']} images"
        " say that the car stands while it drives"
    )


def page(kept: str) -> str:
    """What `--output` wrote, as a page."""
    content = json.loads(kept)
    lines = [
        "# Dashcams drawn by seed",
        "",
        "Streets and dashcams that the method was not built on, rendered in the built-in world, filmed through H.264",
        "(`python -m perf dashcams`), driven with `--height` alone or with `--fov` to five degrees, the camera file",
        "unknown. *Off* is the found focal length over the true one; of a fisheye that is no length of the same kind.",
        "*Scale* is the speed over the true one, the median of valid frames after 2 s, *sigma* what is stated of it,",
        "*beyond* the seconds whose way is off by more than 2 sigma.",
        "",
        f"{total_text(content['total'])}.",
        "",
        "| seed | dashcam | `--fov` | m/s | off | valid after 2 s | scale | sigma | beyond, s | standstill |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in content["rows"]:
        scale, sigma = (row[name] for name in ("speed_over_truth", "sigma_rel"))
        cells = (
            row["seed"],
            row["dashcam"],
            row["lens"].partition(":")[0].removeprefix("--fov "),
            f"{row['speed_mps']:.1f}",
            f"{row['focal_over_true'] - 1.0:+.0%}",
            f"{row['valid_after_2_s']:.0%}",
            "-" if scale is None else f"{scale:.3f}",
            "-" if sigma is None else f"{sigma:.0%}",
            row["beyond_s"],
            row["standstill"],
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"
