"""The catalogue of networks that `birdslam models add NAME` installs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

CATALOGUE = Path(__file__).parent / "catalogue.toml"


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An ONNX file in a public repository, pinned to a commit and to its SHA-256."""

    title: str
    manifest: str  # name of a shipped manifest
    repository: str
    commit: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{40}$")]
    path: str
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    size_bytes: Annotated[int, msgspec.Meta(ge=1)]
    licence: str


class Catalogue(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The networks by name; `address` is the template of their URLs."""

    address: str
    models: dict[str, Entry]

    def address_of(self, entry: Entry) -> str:
        """Returns the URL of an entry."""
        return self.address.format(repository=entry.repository, commit=entry.commit, path=entry.path)


def catalogue() -> Catalogue:
    """Reads the catalogue of the package."""
    return msgspec.toml.decode(CATALOGUE.read_bytes(), type=Catalogue)
