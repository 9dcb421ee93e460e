"""Which function each command of `birdslam` is, and what a user can mend: one line and exit status 2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from birdslam.calibration.calibration import CalibrationError
from birdslam.outputs.drive_files import ResultsError
from birdslam.perception import ModelError
from birdslam.ros.bag import BagError
from birdslam.runtime.cli import calibrate, deploy, listen, replay, top
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.doctor import checks as doctor
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.evaluation import lanes as evaluate_lanes
from birdslam.runtime.evaluation import odometry as evaluate_odometry
from birdslam.runtime.models import command as models
from birdslam.runtime.models.download import DownloadError
from birdslam.runtime.nodes.sources import SourceError
from birdslam.runtime.options import configuration_of
from birdslam.runtime.pages import configuration as configuration_page
from birdslam.runtime.pages import interface
from birdslam.runtime.recording.recording import RecordingError
from birdslam.runtime.supervision import run as running
from birdslam.runtime.transport.bus import BusError
from birdslam.runtime.transport.presence import VehicleBusy
from birdslam.runtime.world import demo_drive
from birdslam.sources.recording import DatasetError

USER_ERRORS = (
    BagError,
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
    try:
        return COMMANDS[options.command](options)
    except USER_ERRORS as error:
        print(f"birdslam: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR_STATUS


def run(options: argparse.Namespace) -> int:
    """`birdslam run`: the three processes."""
    return running.run(configuration_of(options))


def view(options: argparse.Namespace) -> int:
    """`birdslam view`; imported only here: rerun is an extra."""
    from birdslam.runtime.recording import rerun_view as viewing

    return viewing.view(options)


def export(options: argparse.Namespace) -> int:
    """`birdslam export`; imported only here: scipy's rotations and Foxglove's types would lie in a drive's memory."""
    from birdslam.runtime.cli import export as exporting

    return exporting.export(options)


def top_or_all(options: argparse.Namespace) -> int:
    """`birdslam top`: one vehicle, or all of a fleet; the latter is imported only here, as no vehicle needs it."""
    if options.all is None:
        return top.top(options.vehicle, options.runtime_dir, options.once)
    from birdslam.runtime.cli import fleet

    return fleet.top_all(options.all, options.once)


def listen_or_all(options: argparse.Namespace) -> int:
    """`birdslam listen`: one vehicle, or all of a fleet."""
    if options.all is None:
        return listen.listen(options)
    from birdslam.runtime.cli import fleet

    return fleet.listen_all(options)


def uplink(options: argparse.Namespace) -> int:
    """`birdslam uplink`."""
    from birdslam.runtime.cli import fleet

    return fleet.uplink(options)


def router(options: argparse.Namespace) -> int:
    """`birdslam router`."""
    from birdslam.runtime.cli import fleet

    return fleet.route(options)


def batch(options: argparse.Namespace) -> int:
    """`birdslam batch`; imported only here, since no drive needs it."""
    from birdslam.runtime.cli import batch as batching

    return batching.batch(options)


def evaluate_tracking(options: argparse.Namespace) -> int:
    """`birdslam evaluate tracking` and `ablation`; imported only here: gtsam would lie in a drive's memory."""
    from birdslam.runtime.evaluation import tracking

    return tracking.evaluate(options, configuration_of(options))


def evaluate_localisation(options: argparse.Namespace) -> int:
    """`birdslam evaluate localisation`; imported only here: scipy.stats would lie in a drive's memory."""
    from birdslam.runtime.evaluation import localisation

    return localisation.evaluate(options, configuration_of(options))


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": run,
    "replay": replay.replay,
    "export": export,
    "view": view,
    "top": top_or_all,
    "listen": listen_or_all,
    "uplink": uplink,
    "router": router,
    "doctor": doctor.check_machine,
    "deploy": deploy.deploy,
    "interface": interface.print_page,
    "configuration": configuration_page.print_page,
    "batch": batch,
    "calibrate": calibrate.calibrate_camera,
    "models list": models.list_models,
    "models check": models.check,
    "models add": models.add,
    "demo-drive make": demo_drive.make,
    "evaluate odometry": evaluate_odometry.evaluate_odometry,
    "evaluate car-ahead": evaluate_odometry.evaluate_car_ahead,
    "evaluate lanes": evaluate_lanes.evaluate,
    "evaluate localisation": evaluate_localisation,
    "evaluate tracking": evaluate_tracking,
    "evaluate ablation": evaluate_tracking,
}
