"""Recommended networks for real roads; the shipped one was trained on rendered streets only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from birdslam.runtime.models import store
from birdslam.runtime.models.catalogue import Entry, catalogue
from birdslam.runtime.models.install import install, installation_of

RECOMMENDED = ("yolox_nano", "twinlitenet")  # a detector and a segmenter, of the catalogue


@dataclass(frozen=True)
class Recommended:
    """Names of the installed recommended networks, and catalogue entries of the missing ones."""

    at_hand: tuple[str, ...]
    missing: dict[str, Entry]

    @property
    def question(self) -> str:
        """The question whether to download the missing ones."""
        each = ", ".join(f"{name} ({entry.licence})" for name, entry in self.missing.items())
        megabytes = sum(entry.size_bytes for entry in self.missing.values()) / 1e6
        return (
            "The shipped network was trained on rendered streets only and detects 40 to 80 % of real cars. "
            f"Download {each}, {megabytes:.1f} MB, from their authors?"
        )


def recommended(directory: Path) -> Recommended:
    """Returns which recommended networks are installed in the models directory."""
    at_hand, known = store.installed(directory), catalogue().models
    return Recommended(
        tuple(name for name in RECOMMENDED if name in at_hand),
        {name: known[name] for name in RECOMMENDED if name not in at_hand},
    )


def fetch(names: tuple[str, ...], directory: Path) -> None:
    """Installs networks of the catalogue. Raises ModelError or DownloadError."""
    for name in names:
        install(installation_of(name, "", "", "", catalogue().models[name].size_bytes), directory)
