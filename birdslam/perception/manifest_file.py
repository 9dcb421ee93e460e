"""Manifests as files.

A manifest is the first of these that exists: the one named explicitly (a path, or the name of a shipped one), the file
beside the network with the same stem, the shipped one with the network's SHA-256, the shipped one with its stem.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, TypeVar

import msgspec

from birdslam.perception.manifest import Manifest, ModelError, Sha256

SHIPPED_DIRECTORY = Path(__file__).parent / "manifests"


class Described(Protocol):
    """The fields of every kind of manifest."""

    @property
    def role(self) -> str: ...
    @property
    def sha256(self) -> str: ...


Kind = TypeVar("Kind", bound=Described)


class ManifestHeader(msgspec.Struct, frozen=True):
    """The fields that identify a manifest of any kind."""

    role: str
    title: str = ""
    sha256: Sha256 = ""


def read_manifest(path: Path) -> Manifest:
    """The manifest in a TOML file. Raises ModelError naming the file and the key."""
    return read_as(path, Manifest)


def read_as(path: Path, kind: type[Kind]) -> Kind:
    """A manifest of some kind in a TOML file. Raises ModelError naming the file and the key."""
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ModelError(f"{path}: the manifest can't be read: {error.strerror}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: {error}") from error


def shipped_manifests() -> dict[str, Path]:
    """Name -> file of the manifests inside the package, in order of name."""
    return {path.stem: path for path in sorted(SHIPPED_DIRECTORY.glob("*.toml"))}


def find_manifest(network: Path, sha256: str, explicit: str = "") -> tuple[Manifest, Path]:
    """The manifest of a network file with the given hash, and its path (see the module's docstring).

    Raises ModelError if it is missing, unreadable, or states another hash.
    """
    return find_as(network, sha256, explicit, Manifest)


def find_as(network: Path, sha256: str, explicit: str, kind: type[Kind]) -> tuple[Kind, Path]:
    """`find_manifest` for a manifest of another kind."""
    path = _locate(network, sha256, explicit)
    manifest = read_as(path, kind)
    if manifest.sha256 and manifest.sha256 != sha256:
        raise ModelError(f"{network}: sha256: the manifest {path} says {manifest.sha256}, the file has {sha256}")
    return manifest, path


def _locate(network: Path, sha256: str, explicit: str) -> Path:
    shipped = shipped_manifests()
    if explicit:
        path = shipped.get(explicit, Path(explicit))
        if not path.is_file():
            raise ModelError(
                f"{network}: the manifest {explicit!r} does not exist; name a file or one of {', '.join(shipped)}"
            )
        return path
    beside = network.with_suffix(".toml")
    if beside.is_file():
        return beside
    for path in shipped.values():
        if read_manifest(path).sha256 == sha256:
            return path
    if network.stem in shipped:
        return shipped[network.stem]
    raise ModelError(
        f"{network}: no manifest: none beside it ({beside.name}), none shipped with its SHA-256 {sha256} or its name "
        f"(shipped: {', '.join(shipped)}); name one with manifest ="
    )
