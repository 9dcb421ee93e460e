"""What installs the service on a vehicle computer, out of the package: deploy/install.sh needs no checkout."""

from __future__ import annotations

import shutil
from importlib.metadata import version
from pathlib import Path

import birdslam
from birdslam.runtime.configuration import ConfigurationError

PARTS = ("deploy", "configs/vehicle.toml")
PACKAGE = "package"  # what install.sh hands to pip


def write_deployment(target: Path) -> Path:
    """Writes the new folder `target`; gives its folder `deploy`. Raises ConfigurationError."""
    if target.exists():
        raise ConfigurationError(f"{target}: is there already")
    source = Path(birdslam.__file__).parent
    try:
        for part in PARTS:
            (target / part).parent.mkdir(parents=True, exist_ok=True)
            if (source / part).is_dir():
                shutil.copytree(source / part, target / part, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source / part, target / part)
        (target / PACKAGE).write_text(f"birdslam=={version('birdslam')}\n", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{error.filename or target}: {error.strerror}") from None
    return target / "deploy"
