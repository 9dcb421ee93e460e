"""Writes the files that install the service on a vehicle computer without a checkout."""

from __future__ import annotations

import shutil
from importlib.metadata import version
from pathlib import Path

from birdslam.runtime.configuration import ConfigurationError

SOURCE = Path(__file__).resolve().parents[1]  # deploy/ and configs/ are beside runtime/
PACKAGE = "package"  # file with the requirement for pip, read by install.sh


def write_deployment(target: Path) -> Path:
    """Writes the new folder `target` and returns its folder `deploy`. Raises ConfigurationError."""
    if target.exists():
        raise ConfigurationError(f"{target}: exists; name a new folder")
    deploy, configs = target / "deploy", target / "configs"
    try:
        for folder in (deploy, configs):
            folder.mkdir(parents=True)
        for entry in (SOURCE / "deploy").iterdir():
            if entry.is_file():
                shutil.copy(entry, deploy)
        shutil.copy(SOURCE / "configs" / "vehicle.toml", configs)
        (target / PACKAGE).write_text(f"birdslam=={version('birdslam')}\n", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{error.filename or target}: {error.strerror}") from None
    return deploy
