"""What the commands of `birdslam` do (runtime/cli/main.py parses them)."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec

from birdslam.calibration.calibration import CalibrationError
from birdslam.datasets.opening import open_recording
from birdslam.datasets.recording import DatasetError, Recording
from birdslam.evaluation.odometry import OdometryReport, evaluate_recordings
from birdslam.evaluation.results import ResultsError
from birdslam.perception import ModelError
from birdslam.runtime import model_store
from birdslam.runtime.cli import (
    calibrate,
    configuration_page,
    demo_drive,
    doctor,
    interface,
    models,
    recording_commands,
)
from birdslam.runtime.cli.download import DownloadError
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import (
    FILE_SCHEMES,
    NO_MODEL,
    Configuration,
    ConfigurationError,
    complete,
    load,
    parse_setting,
)
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, SourceError, offline_frames
from birdslam.runtime.recording.recording import RecordingError
from birdslam.runtime.supervision import supervisor
from birdslam.runtime.transport.bus import BusError
from birdslam.runtime.transport.presence import VehicleBusy
from birdslam.slam import BirdSLAM
from birdslam.types import Estimate, MapUpdate, Measurements, Status

USER_ERRORS = (
    CalibrationError,
    ConfigurationError,
    DatasetError,
    DownloadError,
    ModelError,
    RecordingError,
    ResultsError,
    SourceError,
    BusError,
    VehicleBusy,
)


def execute(options: argparse.Namespace) -> int:
    """The command that was parsed; gives the exit status."""
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "run": run,
        "replay": recording_commands.replay,
        "view": recording_commands.view,
        "top": recording_commands.top,
        "listen": listen,
        "doctor": examine,
        "interface": describe_interface,
        "configuration": describe_configuration,
        "calibrate": calibrate_camera,
        "models list": models.list_models,
        "models check": models.check,
        "models add": models.add,
        "demo-drive make": demo_drive.make,
        "evaluate odometry": evaluate_odometry,
        "evaluate car-ahead": evaluate_car_ahead,
        "evaluate localisation": evaluate_vehicles,
        "evaluate tracking": evaluate_benchmark,
        "evaluate ablation": evaluate_benchmark,
    }
    try:
        return commands[options.command](options)
    except USER_ERRORS as error:
        print(f"birdslam: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR_STATUS


def configuration_of(options: argparse.Namespace) -> Configuration:
    """The configuration file with the options of the command line on top. Raises ConfigurationError."""
    overrides: dict[str, Any] = dict(parse_setting(text) for text in options.set)
    named: list[str] = []
    for text in options.model:
        role, equals, path = text.partition("=")
        if text == NO_MODEL:
            overrides["models.shipped"] = False
        elif not equals and model_store.is_name(text):
            named.append(text)
        elif role and equals and path:
            overrides[f"models.{role}.path"] = path
        else:
            raise ConfigurationError(f"--model {text}: expected ROLE=PATH, or the name of a model")
    keys = {"source": "source.uri", "rate": "source.rate", "stride": "source.stride"}
    keys |= {"record": "recording.file", "record_images": "recording.images"}
    for name in ("source", "rate", "stride", "camera", "vehicle", "record", "record_images", "output"):
        value = getattr(options, name, None)
        if value is not None:
            overrides[keys.get(name, name)] = _number(value) if name == "rate" else value
    return load(options.config, overrides, named)


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def run(options: argparse.Namespace) -> int:
    """`birdslam run`: the three processes."""
    return supervisor.run(configuration_of(options))


def examine(options: argparse.Namespace) -> int:
    """`birdslam doctor`: a row for each check; 1 where one is an error."""
    findings = list(doctor.examine(configuration_of(options)))
    print(doctor.table(findings))
    return int(any(finding.verdict == "error" for finding in findings))


def describe_interface(options: argparse.Namespace) -> int:
    """`birdslam interface`: the page of keys, records and statuses."""
    print(interface.page(), end="")
    return 0


def describe_configuration(options: argparse.Namespace) -> int:
    """`birdslam configuration`: the page of every key."""
    print(configuration_page.page(), end="")
    return 0


def listen(options: argparse.Namespace) -> int:
    """`birdslam listen`: estimates as they come; 1 where none came within the time-out."""
    left, vehicle = options.count, options.vehicle
    supervisor.check_runtime_dir(vehicle, options.runtime_dir)
    with Planner(vehicle, options.runtime_dir) as planner:
        while left is None or left > 0:
            estimate = planner.wait(options.timeout)
            if estimate is None:
                print(f"birdslam: no estimate of vehicle {vehicle!r} in {options.timeout:g} s", file=sys.stderr)
                return 1
            print(_as_line(estimate, planner.latest().age_ms, options.json), flush=True)
            left = None if left is None else left - 1
            if Status.END_OF_SOURCE in estimate.status:
                return 0
    return 0


def _as_line(estimate: Estimate, age_ms: float, as_json: bool) -> str:
    if as_json:
        return msgspec.json.encode(estimate).decode()
    pose = estimate.T_world_ego
    vehicles = "  ".join(
        f"{v.label} {v.vehicle} at {v.T_world_vehicle.x_m:.1f} {v.T_world_vehicle.y_m:.1f} m" for v in estimate.vehicles
    )
    return (
        f"frame {estimate.frame_id}  epoch {estimate.epoch}  x {pose.x_m:.2f} m  y {pose.y_m:.2f} m  "
        f"yaw {pose.yaw_rad:.3f} rad  age {age_ms:.1f} ms  {'valid' if estimate.valid else 'NOT VALID'}  "
        f"{' '.join(estimate.status)}  {vehicles}"
    ).rstrip()


def calibrate_camera(options: argparse.Namespace) -> int:
    """`birdslam calibrate`: a camera file from a drive."""
    return calibrate.run(options, configuration_of(options))


Drive = Callable[[Recording], Iterator[Measurements | Estimate | MapUpdate]]


def _uri(text: str) -> str:
    return text if text.partition(":")[0] in FILE_SCHEMES else f"kitti:{text}"


@contextlib.contextmanager
def _pipeline(configuration: Configuration) -> Iterator[Drive]:
    """The whole method in this process, on frames as capture makes them, awaiting every network.

    Gives each frame's Measurements, its Estimate, and what the map gained.
    """
    configuration = msgspec.structs.replace(
        configuration, source=msgspec.structs.replace(configuration.source, rate="max")
    )
    cv2.setNumThreads(configuration.perceive.opencv_threads)
    with contextlib.ExitStack() as stack:

        def drive(recording: Recording) -> Iterator[Measurements | Estimate | MapUpdate]:
            source = RecordedSource(recording, configuration.source)
            inference = stack.enter_context(Inference(complete(configuration, recording.camera, source.rate_hz)))
            slam = BirdSLAM(
                recording.camera,
                inference.networks,
                configuration.slam,
                frustum_network=inference.frustum_network,
                lane_head=inference.lane_head,
            )
            for frame in offline_frames(source):
                yield from slam.step(frame)
                gained = slam.map_update()
                if gained is not None:
                    yield gained

        yield drive


def evaluate_odometry(options: argparse.Namespace) -> int:
    """`birdslam evaluate odometry`: trajectories against the truth; writes report.json and prints a table."""
    print(_odometry_table(_evaluate(options)))
    return 0


def evaluate_car_ahead(options: argparse.Namespace) -> int:
    """`birdslam evaluate car-ahead`: the distance to the car ahead against the recording's LiDAR."""
    for report in _evaluate(options):
        ahead = report.car_ahead
        if ahead is None:
            raise ConfigurationError(f"{report.sequence}: has no LiDAR (lidar_cam0 beside its images) to compare with")
        if ahead.error_median_rel is None or ahead.error_p90_rel is None or ahead.bias_median_rel is None:
            print(f"{report.sequence}: no car ahead in {report.frames} frames")
        else:
            print(
                f"{report.sequence}: {ahead.frames} frames with a car ahead, error of its distance: "
                f"median {ahead.error_median_rel:.1%}, 90 % within {ahead.error_p90_rel:.1%}, "
                f"bias {ahead.bias_median_rel:+.1%}"
            )
    return 0


def evaluate_benchmark(options: argparse.Namespace) -> int:
    """`birdslam evaluate tracking` and `ablation`: the paper's tables on KITTI tracking."""
    from birdslam.runtime.cli import evaluate_tracking  # only here: gtsam would lie in a drive's memory

    return evaluate_tracking.evaluate(options, configuration_of(options))


def evaluate_vehicles(options: argparse.Namespace) -> int:
    """`birdslam evaluate localisation`: vehicles' places against labels."""
    from birdslam.runtime.cli import evaluate_localisation  # only here: scipy.stats would lie in a drive's memory

    return evaluate_localisation.evaluate(options, configuration_of(options))


def _evaluate(options: argparse.Namespace) -> list[OdometryReport]:
    configuration = configuration_of(options)
    source = configuration.source
    if source.frames is not None or source.loop:
        raise ConfigurationError("source.frames, source.loop: evaluate takes whole recordings, once")
    recordings = [open_recording(_uri(text), configuration.camera, source.stride) for text in options.sequences]
    twice = [name for name, n in Counter(recording.name for recording in recordings).items() if n > 1]
    if twice:
        raise ConfigurationError(f"two sequences are named {twice[0]}: their results would overwrite each other")
    if not configuration.models.in_use():
        print(supervisor.WITHOUT_MODELS)
    with _pipeline(configuration) as drive:
        reports = evaluate_recordings(
            recordings, drive, Path(configuration.output), compared=_compared(options.frames, recordings)
        )
    print(f"results in {configuration.output}")
    return reports


def _compared(text: str, recordings: list[Recording]) -> slice:
    """The frames FIRST:END (either may be missing) that are held to the truth; at least two of each recording."""
    first, colon, end = text.partition(":")
    numbers = [part for part in (first, end) if part]
    if not colon or not all(part.isdecimal() for part in numbers):
        raise ConfigurationError(f"--frames {text}: expected FIRST:END, such as 14: or 14:120")
    frames = slice(int(first) if first else None, int(end) if end else None)
    for recording in recordings:
        if len(range(*frames.indices(len(recording)))) < 2:
            raise ConfigurationError(
                f"--frames {text}: fewer than two of the {len(recording)} frames of {recording.name}"
            )
    return frames


def _odometry_table(reports: list[OdometryReport]) -> str:
    columns = (
        ("frames", "frames", 0),
        ("path m", "path_m", 1),
        ("ATE m", "ate_m", 3),
        ("ATE %", "ate_pct", 2),
        ("ATE se3 m", "ate_se3_m", 3),
        ("ATE sim3 m", "ate_sim3_m", 3),
        ("scale error", "scale_error", 4),
        ("RPE m", "rpe_t_m", 4),
        ("RPE deg", "rpe_r_deg", 4),
        ("segments %", "segment_t_pct", 2),
        ("standing m", "standing_drift_m", 3),
        ("NEES", "ego.nees", 2),
        ("inside 95 %", "ego.inside_95", 2),
    )
    lines = [f"{'sequence':16}" + "".join(f"{title:>12}" for title, _, _ in columns)]
    for report in reports:
        values = [(_field(report, name), digits) for _, name, digits in columns]
        cells = "".join(f"{'-' if value is None else format(value, f'.{digits}f'):>12}" for value, digits in values)
        lines.append(f"{report.sequence:16}{cells}")
    return "\n".join(lines)


def _field(report: Any, name: str) -> float | None:
    """A field of a report, or of a report in it: `ego.nees`; None where that is not there."""
    for part in name.split("."):
        report = None if report is None else getattr(report, part)
    return cast("float | None", report)
