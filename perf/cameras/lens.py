"""A lens from the drive alone: how far its focal length and distortion are off, and by how much they say so.

    python -m perf lens [DRIVE ...] [--output DIR] [--data DIR] [--films DIR] [--render DIR] [--images N] [--networks]

Each drive twice, with a focal length beforehand that is 15 % too long and 15 % too short, known to 15 %. Rows: turn of
the camera, errors of focal length and k1 with their own sigma, whether the drive showed the focal length, the bend by
upright lines, and the way of its first 6 s by the found lens over that by the true one. Rendered dashcams lie in
`--films`; `--render` renders them anew (extra `train`, PyAV). Writes lens.json and lens.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.calibration.lens import self_calibrate
from birdslam.calibration.lens_windows import followed_corners
from birdslam.calibration.readout import readout_of_drive
from birdslam.calibration.uprights import UPRIGHT_IMAGES, lens_by_uprights, upright_edges
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.odometry.odometry import Odometry
from birdslam.perf.accuracy.drives import is_valid, networks_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.ros.bag import BagTopics
from birdslam.runtime.calibration.given import Given, lens_of
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import as_poses
from birdslam.types import NS_PER_S, Frame

label = "a lens from the drive alone: errors and own sigmas of focal length and distortion"

Image = NDArray[np.uint8]
PRIORS = 1.15, 1.0 / 1.15
PRIOR_SIGMA = 0.15
METRES_S = 6.0  # of a drive, whose way is compared
NO_BOXES = np.zeros((0, 4))


@dataclass(frozen=True)
class Recorded:
    """A drive whose lens is known: by the recording, or by photographs of a chessboard."""

    uri: str
    chessboard: str | None = None
    global_shutter: bool = True


RECORDED = {
    "00": Recorded("kitti:{data}/kitti_odometry/sequences/00"),
    "01": Recorded("kitti:{data}/kitti_odometry/sequences/01"),
    "06": Recorded("kitti:{data}/kitti_odometry/sequences/06"),
    "0005": Recorded("kitti:{data}/kitti_tracking/training/image_03/0005"),
    "0002": Recorded("kitti:{data}/kitti_tracking/training/image_02/0002"),
    "two_passes": Recorded("kitti:{data}/two_passes/left"),
    "motorway": Recorded("video:{data}/highway/solidWhiteRight.mp4", "highway/camera_cal", global_shutter=False),
}


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("lens", label, output="folder of lens.json and lens.md")
    parser.add_argument("drives", nargs="*", metavar="DRIVE", help=f"of {', '.join(RECORDED)}, or of a rendered one")
    parser.add_argument("--films", type=Path, default=Path("tests/dashcams"), help="rendered dashcams")
    parser.add_argument("--render", type=Path, metavar="DIR", help="render the dashcams into DIR, and no more")
    parser.add_argument("--images", type=int, default=60, help="of each rendered dashcam")
    add_data(parser)
    add_networks(parser)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    if options.render is not None:
        render(options.render, options.drives, options.images)
        return
    rendered = {path.stem: path for path in sorted(options.films.glob("*.mp4"))}
    unknown = set(options.drives) - set(RECORDED) - set(rendered)
    if unknown:
        raise PerfError(f"{', '.join(sorted(unknown))}: no such drive; there are {', '.join((*RECORDED, *rendered))}")
    output = options.output
    try:
        with Ledger(None if output is None else output / "lens.json", label) as ledger:
            for name in options.drives or (*RECORDED, *rendered):
                drive = _rendered(rendered[name]) if name in rendered else _recorded(RECORDED[name], options.data)
                for row in rows_of(drive, networks_of(options)):
                    prior = f"{row['prior'] - 1.0:+.0%}"
                    ledger.add(f"{name}, prior {prior}", row_text(row), drive=name, **row)
            rows = ledger.content["rows"]
    except DatasetError as error:
        raise PerfError(str(error)) from error
    if output is not None:
        (output / "lens.md").write_text(table(rows), encoding="utf-8")
        print(f"results in {output}")


def render(directory: Path, names: list[str], images: int) -> None:
    """Films of the dashcams (or of those named) along the shipped drive's street, each with its camera file."""
    try:
        from birdslam.world.dashcam import DASHCAMS, film, write_film
        from birdslam.world.demo_world import demo_scenario
    except ImportError as error:
        raise PerfError(f"rendering needs the extra `train` (pip install 'birdslam[train]'): {error}") from None
    directory.mkdir(parents=True, exist_ok=True)
    for name in names or DASHCAMS:
        poses: list[NDArray[np.float64]] = []

        def shown(name: str, poses: list[NDArray[np.float64]]) -> Iterator[Image]:
            for frame in film(demo_scenario(), DASHCAMS[name], images, RENDERED_HZ):
                poses.append(frame.T_world_cam)
                yield frame.image

        write_film(directory / f"{name}.mp4", shown(name, poses), RENDERED_HZ, RENDERED_CRF)
        np.savez_compressed(directory / f"{name}.npz", T_world_cam=np.array(poses))
        camera = DASHCAMS[name].camera
        keys = (
            "width_px",
            "height_px",
            "fx_px",
            "fy_px",
            "cx_px",
            "cy_px",
            "height_m",
            "distortion",
            "fisheye",
            "readout_s",
        )
        lines = [f"{key} = {getattr(camera, key)!r}".replace("False", "false").replace("True", "true") for key in keys]
        text = "\n".join(lines).replace("(", "[").replace(")", "]") + "\n"
        (directory / f"{name}.toml").write_text(text, encoding="utf-8")
        print(f"{name}: {images} images")


RENDERED_HZ, RENDERED_CRF = 10.0, 27


@dataclass(frozen=True)
class Drive:
    """A drive with its true lens; its truth (N, 4, 4), where there is one, has the camera's poses."""

    recording: Recording
    T_world_cam: NDArray[np.float64] | None
    readout_s: float | None  # None: nobody knows it


def _rendered(path: Path) -> Drive:
    with np.load(path.with_suffix(".npz")) as kept:
        poses = kept["T_world_cam"]
    recording = open_recording(f"video:{path}", load_camera(path.with_suffix(".toml")))
    return Drive(recording, poses, recording.camera.readout_s)


def _recorded(drive: Recorded, data: Path) -> Drive:
    recording = _open(drive, data)
    rows = recording.truth_poses()
    return Drive(recording, None if rows is None else as_poses(rows), 0.0 if drive.global_shutter else None)


def _open(drive: Recorded, data: Path) -> Recording:
    uri = drive.uri.format(data=data)
    if drive.chessboard is None:
        return open_recording(uri)
    lens, height_m = lens_of(Given(chessboard=data / drive.chessboard, height_m=1.25), uri, BagTopics())
    assert lens is not None
    size = _size(uri)
    lens = lens.for_size(*size)
    camera = Camera(
        *size, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, height_m=height_m or 1.25, distortion=lens.distortion
    )
    return open_recording(uri, camera)


def _size(uri: str) -> tuple[int, int]:
    from birdslam.sources.films.video import VideoRecording

    return VideoRecording.frame_size(Path(uri.partition(":")[2]), BagTopics())


def rows_of(drive: Drive, configuration: Configuration | None) -> Iterator[dict[str, Any]]:
    """The lens of a drive by each prior, beside the true one."""
    recording = drive.recording
    camera = recording.camera
    true_px = 0.5 * (camera.fx_px + camera.fy_px)
    true_k1 = camera.distortion[0] if camera.distortion and not camera.fisheye else 0.0
    images = [frame.image for frame in recording.frames() if frame.image is not None]
    boxes = _boxes(recording, configuration, images)
    times_s = [frame.t_source_ns / NS_PER_S for frame in recording.frames() if frame.image is not None]
    corners = followed_corners(zip(images, boxes, times_s, strict=True), camera)
    uprights = lens_by_uprights([upright_edges(image) for image in images[:: max(1, len(images) // UPRIGHT_IMAGES)]])
    bend = None if uprights is None else (uprights.bend, uprights.bend_sigma)
    by_lines = {
        "true_bend": true_k1 * (camera.width_px / true_px) ** 2,
        "bend": None if bend is None else bend[0],
        "bend_sigma": None if bend is None else bend[1],
    }
    readout = readout_of_drive(corners, camera)
    by_rows = {
        "true_readout_s": drive.readout_s,
        "readout_by_drive": readout.by_drive,
        "readout_s": readout.readout_s,
        "readout_sigma_s": readout.sigma_s,
    }
    some = images[: max(2, round(METRES_S * recording.rate_hz))]
    true_way_m, over_truth = way_m(camera, some, recording.rate_hz, drive.T_world_cam)
    for prior in PRIORS:
        lens = self_calibrate(corners, (camera.width_px, camera.height_px), prior * true_px, PRIOR_SIGMA, bend=bend)
        same = {"prior": prior, "images": len(images), "true_px": true_px, "true_k1": true_k1, **by_lines, **by_rows}
        if lens is None:
            yield {**same, "focal_shown": None}
            continue
        found = replace(
            camera,
            fx_px=lens.focal_px,
            fy_px=lens.focal_px,
            pitch_rad=0.0,
            roll_rad=0.0,
            distortion=(lens.k1, 0.0, 0.0, 0.0),
            fisheye=False,
        )
        found_way_m, _ = way_m(found, some, recording.rate_hz, None)
        yield {
            **same,
            "turned_deg": math.degrees(lens.turned_rad),
            "windows": lens.windows,
            "focal_error": math.log(lens.focal_px / true_px),
            "focal_sigma": lens.focal_sigma_rel,
            "k1": lens.k1,
            "k1_sigma": lens.k1_sigma,
            "focal_shown": lens.focal_shown,
            "way_by_true_lens": over_truth,
            "way_over_true": None if not true_way_m or not found_way_m else found_way_m / true_way_m,
        }


def _boxes(recording: Recording, configuration: Configuration | None, images: list[Image]) -> list[Any]:
    if configuration is None:
        return [NO_BOXES] * len(images)
    boxes = []
    with Inference(complete(configuration, recording.camera, recording.rate_hz)) as inference:
        for k, image in enumerate(images):
            found = inference.start(Frame(k, k, k, k, image)).result().detections
            boxes.append(NO_BOXES if found is None else found.boxes_px)
    return boxes


def way_m(
    camera: Camera, images: list[Image], rate_hz: float, T_world_cam: NDArray[np.float64] | None
) -> tuple[float | None, float | None]:
    """The mean step by the odometry through this lens, over its valid frames, and that over the truth.

    None where less than half of the frames are valid.
    """
    odometry, undistort = Odometry(camera), Undistorter(camera)
    way, true, valid = 0.0, 0.0, 0
    for k, image in enumerate(images):
        motion = odometry.estimate(odometry.track(undistort(image)), k, round(k * 1e9 / rate_hz), NO_BOXES, None)
        if motion is not None and is_valid(motion):
            way, valid = way + float(np.linalg.norm(motion.t_prev_curr_m)), valid + 1
            if T_world_cam is not None:
                true += float(np.linalg.norm(T_world_cam[k, :3, 3] - T_world_cam[motion.from_frame, :3, 3]))
    if valid <= len(images) // 2:
        return None, None
    return way / valid, way / true if true > 0.0 else None


def row_text(row: dict[str, Any]) -> str:
    """A row for a person."""
    if row["focal_shown"] is None:
        return "too little to see"
    way = _off(row["way_over_true"])
    return (
        f"turned {row['turned_deg']:.0f} deg, f {row['focal_error']:+.1%} +- {row['focal_sigma']:.1%} "
        f"{'' if row['focal_shown'] else '(kept) '} k1 {row['k1']:+.3f} +- {row['k1_sigma']:.3f} (true "
        f"{row['true_k1']:+.3f}; bend by lines {_bend(row)}, true {row['true_bend']:+.2f}), way {way}, "
        f"by the true lens {_off(row['way_by_true_lens'])} of the truth; "
        f"rows by the drive {_ms(row['readout_by_drive'])} ms (true {_ms(row['true_readout_s'])})"
    )


def _bend(row: dict[str, Any]) -> str:
    return "-" if row["bend"] is None else f"{row['bend']:+.2f} +- {row['bend_sigma']:.2f}"


def _ms(readout: tuple[float, float] | float | None) -> str:
    """A time, with its 1-sigma where there is one, in ms."""
    if readout is None:
        return "-"
    return f"{1e3 * readout:.0f}" if isinstance(readout, float) else f"{1e3 * readout[0]:.0f} +- {1e3 * readout[1]:.0f}"


def _off(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio - 1.0:+.1%}"


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a page."""
    out = [
        "# The lens from the drive alone",
        "",
        "Each drive twice: with a focal length beforehand that is 15 % too long and 15 % too short, known to 15 %. The",
        "focal length is *shown* where its own sigma is below 0.7 of that, else it is kept. `way` is what the found",
        f"lens does to the metres of the first {METRES_S:g} s, at the same height. Recorded drives come first, then",
        "rendered dashcams (`birdslam/world/dashcam.py`), whose films lie in tests/dashcams.",
        "",
        "*True lens* is the odometry by the true lens and readout against the true way.",
        "*Readout* is the time from an image's first row to its last, in ms: by the drive alone and the true lens",
        "(birdslam/calibration/readout.py); what a camera file gets of it, where 15 +- 9 ms are usual; the truth.",
        "KITTI's cameras read all rows at once.",
        "",
        "*Bend* is k1 over the square of the focal length in image widths: what lines that are upright in the world",
        "say of it (birdslam/calibration/uprights.py), which the bundle adjustment takes as known beforehand.",
        "",
        "| drive | prior | turn, deg | focal length off by | sigma | | bend by lines | true bend | k1 | sigma "
        "| true k1 | way | true lens | readout by the drive | with what is usual | true |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        head = f"| {row['drive']} | {row['prior'] - 1.0:+.0%} |"
        if row["focal_shown"] is None:
            out.append(f"{head} | | | too little to see | | | | | {row['true_k1']:+.3f} | | | | | |")
            continue
        way = f"{_off(row['way_over_true'])} | {_off(row['way_by_true_lens'])}"
        both = _ms((row["readout_s"], row["readout_sigma_s"]))
        way += f" | {_ms(row['readout_by_drive'])} | {both} | {_ms(row['true_readout_s'])}"
        out.append(
            f"{head} {row['turned_deg']:.0f} | {row['focal_error']:+.1%} | {row['focal_sigma']:.1%} | "
            f"{'shown' if row['focal_shown'] else 'kept'} | {_bend(row)} | {row['true_bend']:+.2f} | "
            f"{row['k1']:+.3f} | {row['k1_sigma']:.3f} | {row['true_k1']:+.3f} | {way} |"
        )
    return "\n".join(out) + "\n"
