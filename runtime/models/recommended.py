"""The networks that a film of a real road wants, beside the shipped one, which has seen rendered streets alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from birdslam.runtime.models import store
from birdslam.runtime.models.catalogue import Entry, catalogue
from birdslam.runtime.models.install import install, installation_of

RECOMMENDED = ("yolox_nano", "twinlitenet")  # a detector and a segmenter, of the catalogue


@dataclass(frozen=True)
class Recommended:
    """Those that are installed, by name, and those that are not, as the catalogue has them."""

    at_hand: tuple[str, ...]
    missing: dict[str, Entry]

    @property
    def question(self) -> str:
        """What somebody is asked who may have the missing ones."""
        each = ", ".join(f"{name} ({entry.licence})" for name, entry in self.missing.items())
        megabytes = sum(entry.size_bytes for entry in self.missing.values()) / 1e6
        return (
            "The network that ships has seen rendered streets alone, and finds four to eight of ten real cars. "
            f"Fetch {each}, {megabytes:.1f} MB, from their authors, once?"
        )


def recommended(directory: Path) -> Recommended:
    """What of the recommended networks lies in the models directory."""
    at_hand, known = store.installed(directory), catalogue().models
    return Recommended(
        tuple(name for name in RECOMMENDED if name in at_hand),
        {name: known[name] for name in RECOMMENDED if name not in at_hand},
    )


def fetch(names: tuple[str, ...], directory: Path) -> None:
    """Installs networks of the catalogue. Raises ModelError or DownloadError."""
    for name in names:
        install(installation_of(name, "", "", "", catalogue().models[name].size_bytes), directory)
