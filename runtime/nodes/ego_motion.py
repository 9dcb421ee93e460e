"""The odometry that a drive is given in place of the images' own."""

from __future__ import annotations

from pathlib import Path

from birdslam.geometry.camera import Camera
from birdslam.odometry.external import ExternalOdometry
from birdslam.runtime.configuration import Configuration
from birdslam.sources.odometry_file import read_odometry
from birdslam.sources.speed_file import of_sequence


def external_odometry(configuration: Configuration, camera: Camera, name: str = "") -> ExternalOdometry | None:
    """Of the file that is configured, in a directory that of the recording's `name`; None: the images' own.

    Raises DatasetError for a file that can't be read.
    """
    if not configuration.source.odometry:
        return None
    path = of_sequence(Path(configuration.source.odometry).expanduser(), name)
    return ExternalOdometry(camera, read_odometry(path), configuration.slam.frontend.external)
