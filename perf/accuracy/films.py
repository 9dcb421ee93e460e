"""One film at other sizes, rates and compressions: whether it gives the same metres.

    python -m perf films [FILM ...] [--output DIR] [--data DIR] [--variant NAME ...] [--begin-at S ...] [--seconds S]
                         [--networks] [--model ROLE=PATH ...]

A film is a name of FILMS. Its camera is found as `birdslam run` finds it, once, and kept in DIR/NAME.toml, from where
it is taken again. Each variant (film_variants.py) is driven by the odometry alone, with what the networks
see of it. Rows: valid frames after the first 2 s, the first valid one, speed over the truth (median over valid frames,
and the median of its deviation from that), way over that of the unchanged film. Writes films.json, films.md, films.png.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.ego.trajectory_errors import from_first
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.odometry.odometry import Odometry
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import is_valid, networks_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.robustness.film_variants import Timed, Variant, variants
from birdslam.runtime.calibration.drive import ROUGH, calibrate_drive
from birdslam.runtime.calibration.given import Given
from birdslam.runtime.calibration.report import write_camera_file
from birdslam.runtime.configuration import Configuration, complete, load
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import as_poses, inverse
from birdslam.types import NS_PER_S, Frame

matplotlib.use("Agg")
import matplotlib.pyplot as plt

label = "one film at other sizes, rates, compressions, and with things in the way: the same metres?"

Floats = NDArray[np.float64]
Look = Callable[[int, int, NDArray[np.uint8]], tuple[Floats, NDArray[np.bool_] | None]]
_BEGINNING_S = 2.0  # of a film, after which it should be valid
ALIKE = 0.03  # of the way: so near the variants of one film should be


@dataclass(frozen=True)
class Film:
    """A film at hand: where it is, what its driver knows of the camera, and its truth."""

    uri: str  # {data} is the folder of data
    height_m: float | None = None
    fov_deg: float | None = None
    chessboard: str | None = None  # folder of its images
    gps: str | None = None  # file of times and speeds
    speed_mps: float | None = None  # all the way

    def given(self, data: Path) -> Given:
        board = None if self.chessboard is None else data / self.chessboard
        return Given(height_m=self.height_m, fov_deg=self.fov_deg, chessboard=board)


FILMS = {
    "town": Film("video:{data}/dashcam/town.mp4", height_m=1.35, fov_deg=60.0, gps="dashcam/town_gps.csv"),
    "motorway": Film(
        "video:{data}/highway/solidWhiteRight.mp4", height_m=1.25, chessboard="highway/camera_cal", speed_mps=25.4
    ),
    "00": Film("kitti:{data}/kitti_odometry/sequences/00"),
    "0005": Film("kitti:{data}/kitti_tracking/training/image_03/0005"),
    "06": Film("kitti:{data}/kitti_odometry/sequences/06"),
    "01": Film("kitti:{data}/kitti_odometry/sequences/01"),
}
DEFAULT = ("town", "motorway", "00", "0005")


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("films", label, output="folder of films.json, films.md, films.png and the cameras")
    parser.add_argument("films", nargs="*", metavar="FILM", help=f"of {', '.join(FILMS)}")
    parser.add_argument("--variant", action="append", default=[], metavar="NAME", help="this one alone; repeatable")
    parser.add_argument("--begin-at", type=float, nargs="+", default=[0.0], metavar="S", help="of the film")
    parser.add_argument("--seconds", type=float, default=np.inf, help="of each variant")
    add_data(parser)
    add_networks(parser)
    options = parser.parse_args(arguments)
    unknown = set(options.films) - set(FILMS)
    if unknown:
        raise PerfError(f"{', '.join(sorted(unknown))}: no such film; there are {', '.join(FILMS)}")
    cv2.setNumThreads(1)
    output = options.output
    try:
        with Ledger(None if output is None else output / "films.json", label) as ledger:
            for name in options.films or DEFAULT:
                film = FILMS[name]
                camera = camera_of(name, film, options.data, output)
                recording = open_recording(film.uri.format(data=options.data), camera)
                true_mps = truth(film, recording, options.data)
                found = [v for v in variants(recording.camera) if not options.variant or v.name in options.variant]
                for begin_s in options.begin_at:
                    unchanged: dict[str, Any] | None = None
                    for variant in found:
                        span_s = begin_s, begin_s + options.seconds
                        figures = measure(recording, variant, span_s, true_mps, networks_of(options))
                        unchanged = unchanged or figures
                        figures["way_over_unchanged"] = over(figures, unchanged)
                        begun = "" if begin_s == 0.0 else f", from {begin_s:g} s"
                        ledger.add(f"{name}: {variant.name}{begun}", row_text(figures), **figures)
            rows = ledger.content["rows"]
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error
    if output is not None:
        (output / "films.md").write_text(table(rows), encoding="utf-8")
        draw(rows, output / "films.png")
        print(f"results in {output}")


def camera_of(name: str, film: Film, data: Path, output: Path | None) -> Camera | None:
    """The camera of a film, by `calibrate`; None of a recording that has its own."""
    if film.height_m is None:
        return None
    kept = None if output is None else output / f"{name}.toml"
    if kept is not None and kept.is_file():
        return load_camera(kept)
    found = calibrate_drive(load(None, {}), film.uri.format(data=data), film.given(data), config=ROUGH)
    if kept is not None:
        write_camera_file(kept, found.camera, found.report)
    return found.camera


@dataclass
class Course:
    """What a variant came to: of each motion its end (s), its speed (m/s), the true one, and whether it is valid."""

    t_s: list[float] = field(default_factory=list)
    speed_mps: list[float] = field(default_factory=list)
    true_mps: list[float] = field(default_factory=list)
    valid: list[bool] = field(default_factory=list)


def measure(
    recording: Recording,
    variant: Variant,
    span_s: tuple[float, float],
    true_mps: Callable[[float, float], float],
    configuration: Configuration | None,
) -> dict[str, Any]:
    """One variant of a film, driven from `span_s`[0] to `span_s`[1]; `true_mps` between two times in s."""
    camera = variant.camera(recording.camera)
    odometry, undistort = Odometry(camera), Undistorter(camera)
    configuration = None if configuration is None else complete(configuration, camera, recording.rate_hz)
    course, times_ns = Course(), []
    with tempfile.TemporaryDirectory() as folder, _looks(configuration) as look:
        images = variant.images(_within(recording, span_s), Path(folder))
        for k, (t_ns, raw) in enumerate(images):
            image = undistort(raw)
            times_ns.append(t_ns)
            motion = odometry.estimate(odometry.track(image), k, t_ns, *look(k, t_ns, image))
            begin_ns = times_ns[k if motion is None else motion.from_frame]
            if motion is None or begin_ns == t_ns:
                continue
            course.t_s.append((t_ns - times_ns[0]) / NS_PER_S)
            course.speed_mps.append(float(np.linalg.norm(motion.t_prev_curr_m)) / (t_ns - begin_ns) * NS_PER_S)
            course.true_mps.append(true_mps(begin_ns / NS_PER_S, t_ns / NS_PER_S))
            course.valid.append(is_valid(motion))
    return summary(course)


def summary(course: Course) -> dict[str, Any]:
    """The figures of a row."""
    t_s, valid = np.array(course.t_s), np.array(course.valid, bool)
    ratio = np.array(course.speed_mps) / np.maximum(np.array(course.true_mps), 0.1)
    counted = valid & (t_s > _BEGINNING_S) & (np.array(course.true_mps) > 1.0)
    median = float(np.median(ratio[counted])) if counted.any() else None
    return {
        "frames": len(t_s),
        "valid_after_2_s": float(valid[t_s > _BEGINNING_S].mean()) if (t_s > _BEGINNING_S).any() else 0.0,
        "first_valid_s": float(t_s[valid.argmax()]) if valid.any() else None,
        "speed_over_truth": median,
        "deviation": None if median is None else float(np.median(np.abs(ratio[counted] / median - 1.0))),
        "by_second": _by_second(t_s, np.where(valid, ratio, np.nan)),
    }


def _by_second(t_s: Floats, ratio: Floats) -> list[float | None]:
    out: list[float | None] = []
    for second in range(int(t_s[-1]) + 1 if len(t_s) else 0):
        here = ratio[(t_s >= second) & (t_s < second + 1)]
        here = here[np.isfinite(here)]
        out.append(round(float(np.median(here)), 3) if len(here) else None)
    return out


def over(figures: dict[str, Any], unchanged: dict[str, Any]) -> float | None:
    """The way over that of the unchanged film: median over the seconds in which both are valid."""
    both = [(a, b) for a, b in zip(figures["by_second"], unchanged["by_second"], strict=False) if a and b]
    return float(np.median([a / b for a, b in both])) if both else None


def truth(film: Film, recording: Recording, data: Path) -> Callable[[float, float], float]:
    """The true speed between two times in s of the recording. Raises DatasetError."""
    if film.speed_mps is not None:
        speed_mps = film.speed_mps
        return lambda begin_s, end_s: speed_mps
    if film.gps is not None:
        t_s, *_, mps = np.loadtxt(data / film.gps, delimiter=",", skiprows=1).T
        return lambda begin_s, end_s: float(np.interp(0.5 * (begin_s + end_s), t_s, mps))
    rows = recording.truth_poses()
    if rows is None:
        raise DatasetError(f"{film.uri}: has no truth")
    T = recording.T_cam0_cam()
    at_m = from_first(inverse(T) @ as_poses(rows) @ T)[:, :3, 3]
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at_m, axis=0), axis=1)))
    times_s = np.array([frame.t_source_ns / NS_PER_S for frame in recording.frames()])

    def by_poses(begin_s: float, end_s: float) -> float:
        return float(np.diff(np.interp([begin_s, end_s], times_s, way_m))[0] / (end_s - begin_s))

    return by_poses


def _within(recording: Recording, span_s: tuple[float, float]) -> Iterator[Timed]:
    first_ns: int | None = None
    for frame in recording.frames():
        first_ns = frame.t_source_ns if first_ns is None else first_ns
        at_s = (frame.t_source_ns - first_ns) / NS_PER_S
        if frame.image is not None and span_s[0] <= at_s < span_s[1]:
            yield frame.t_source_ns, frame.image


@contextmanager
def _looks(configuration: Configuration | None) -> Iterator[Look]:
    """What takes an image's number, time and pixels, and gives the networks' boxes and road."""
    if configuration is None:
        yield lambda k, t_ns, image: (np.zeros((0, 4)), None)
        return
    with Inference(configuration) as inference:

        def look(k: int, t_ns: int, image: NDArray[np.uint8]) -> tuple[Floats, NDArray[np.bool_] | None]:
            found = inference.start(Frame(k, t_ns, t_ns, 0, image)).result()
            boxes = np.zeros((0, 4)) if found.detections is None else found.detections.boxes_px
            return boxes, None if found.segmentation is None else found.segmentation.road

        yield look


def row_text(figures: dict[str, Any]) -> str:
    """A row for a person."""
    return (
        f"valid {figures['valid_after_2_s']:.0%} from {_text(figures['first_valid_s'], '.2f')} s on  speed over truth "
        f"{_text(figures['speed_over_truth'], '.3f')} +- {_text(figures['deviation'], '.1%')}  over the unchanged "
        f"{_text(figures['way_over_unchanged'], '.3f')}"
    )


def _text(figure: float | None, form: str) -> str:
    return "-" if figure is None else format(figure, form)


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a page."""
    head = "| film | valid after 2 s | first valid, s | speed over truth | deviation | way over the unchanged |"
    lines = [head, "|---|---|---|---|---|---|"]
    lines += [
        (
            f"| {row['name']} | {row['valid_after_2_s']:.0%} | {_text(row['first_valid_s'], '.2f')} | "
            f"{_text(row['speed_over_truth'], '.3f')} | {_text(row['deviation'], '.1%')} | "
            f"{_text(row['way_over_unchanged'], '.3f')} |"
        )
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Speed over truth by seconds, a panel for each film."""
    films = list(dict.fromkeys(row["name"].partition(":")[0] for row in rows))
    figure, panels = plt.subplots(len(films), 1, figsize=(10, 3.2 * len(films)), squeeze=False)
    for name, panel in zip(films, panels[:, 0], strict=True):
        for row in rows:
            film, _, variant = row["name"].partition(": ")
            if film == name:
                ratio = [np.nan if value is None else value for value in row["by_second"]]
                panel.plot(np.arange(len(ratio)) + 0.5, ratio, label=variant, linewidth=1)
        panel.set(title=name, xlabel="s", ylabel="speed over truth", ylim=(0.0, 2.0))
        panel.legend(fontsize=6, ncols=2)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
