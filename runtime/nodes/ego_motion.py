"""External odometry in place of visual odometry."""

from __future__ import annotations

from pathlib import Path

from birdslam.geometry.camera import Camera
from birdslam.odometry.external import ExternalOdometry
from birdslam.runtime.configuration import Configuration
from birdslam.sources.odometry_file import read_odometry
from birdslam.sources.speed_file import of_sequence


def external_odometry(configuration: Configuration, camera: Camera, name: str = "") -> ExternalOdometry | None:
    """Returns the odometry of the configured file, or None if there is none.

    In a configured directory it reads the file of the recording's `name`. Raises DatasetError for an unreadable file.
    """
    if not configuration.source.odometry:
        return None
    path = of_sequence(Path(configuration.source.odometry).expanduser(), name)
    return ExternalOdometry(camera, read_odometry(path), configuration.slam.frontend.external)
