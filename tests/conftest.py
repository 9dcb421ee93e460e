"""Where real recordings and networks lie: `BIRDSLAM_DATA`, `BIRDSLAM_MODELS`, else ../shared beside the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def _folder(variable: str, default: str) -> Path:
    folder = Path(os.environ.get(variable) or ROOT.parent / "shared" / default).expanduser().resolve()
    if not folder.is_dir():
        pytest.skip(f"no {default} at {folder} (set {variable})")
    return folder


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; the test skips with its reason where there is none."""
    return _folder("BIRDSLAM_DATA", "data")


@pytest.fixture(scope="session")
def models_dir() -> Path:
    """The folder of real networks; the test skips with its reason where there is none."""
    return _folder("BIRDSLAM_MODELS", "models")
