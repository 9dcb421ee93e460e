"""Installs networks from the catalogue, a file or an address.

A network is fetched, checked and run in a scratch directory, which is then renamed into place. Only the network's graph
is executed, by onnxruntime.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import re
import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from birdslam.perception import ModelError, shipped_manifests
from birdslam.perception.manifest_file import ManifestHeader, find_as
from birdslam.runtime.models import store as model_store
from birdslam.runtime.models.catalogue import catalogue
from birdslam.runtime.models.download import SCHEMES, download
from birdslam.runtime.models.examine import examine
from birdslam.runtime.progress import Progress

TIMEOUT_S = 30.0  # without a byte
MANIFEST_LIMIT_BYTES = 1 << 20
_SCRATCH = ".adding-"


@dataclass(frozen=True)
class Installation:
    """One network to install: its name, source, and expected hash."""

    name: str
    source: str  # a path, or an http(s) address
    manifest: str  # a path, an address, or the name of a shipped one; "": found as for any network
    sha256: str  # "": that of the manifest; a local file needs none
    limit_bytes: int

    @property
    def remote(self) -> bool:
        """Whether the source is an address."""
        return _is_address(self.source)


def installation_of(source: str, name: str, manifest: str, sha256: str, limit_bytes: int) -> Installation:
    """Parses one argument of `models add`. Raises ModelError."""
    if sha256 and not re.fullmatch("[0-9a-f]{64}", sha256.lower()):
        raise ModelError(f"--sha256 {sha256}: expected 64 hexadecimal digits")
    if name and not model_store.is_name(name):
        raise ModelError(f"--name {name}: expected letters, digits, _ . -, without .onnx at the end")
    if model_store.is_name(source) and not Path(source).is_file():
        known = catalogue()
        if source not in known.models:
            raise ModelError(f"{source!r} is neither a file nor in the catalogue, which has {', '.join(known.models)}")
        entry = known.models[source]
        if sha256 and sha256.lower() != entry.sha256:
            raise ModelError(f"{source}: --sha256 {sha256} is not the catalogue's {entry.sha256}")
        size_bytes, address = min(entry.size_bytes, limit_bytes), known.address_of(entry)
        manifest = manifest or entry.manifest
        return Installation(name or source, address, manifest, entry.sha256, size_bytes)
    if source.endswith((".xml", ".bin")):
        raise ModelError(
            f"{source}: OpenVINO IR is not supported; convert it to ONNX with OpenVINO's tools and name that file"
        )
    stem = Path(urlsplit(source).path if _is_address(source) else source).stem
    if not name and not model_store.is_name(stem):
        raise ModelError(f"{source}: {stem!r} is not a valid model name; set one with --name")
    return Installation(name or stem, source, manifest, sha256.lower(), limit_bytes)


def install(wanted: Installation, directory: Path) -> list[str]:
    """Fetches, checks and installs one network; returns the report of `examine`.

    Raises ModelError or DownloadError; nothing is then installed.
    """
    with _scratch(directory) as scratch:
        made = scratch / wanted.name
        made.mkdir()
        network = made / f"{wanted.name}.onnx"
        _fetch(wanted.source, network, wanted.limit_bytes)
        actual = hashlib.sha256(network.read_bytes()).hexdigest()
        if wanted.sha256 and actual != wanted.sha256:
            raise ModelError(f"{wanted.source}: SHA-256 {actual}, but {wanted.sha256} was expected: refused")
        text, pinned = _manifest_text(wanted, network, actual, scratch)
        if wanted.remote and not wanted.sha256 and pinned != actual:
            raise ModelError(f"{wanted.source}: its SHA-256 is unknown; set it with --sha256 or in its manifest")
        network.with_suffix(".toml").write_text(text)
        try:
            lines = examine(network, "")
        except ModelError as error:  # name the source, not the scratch directory
            raise ModelError(f"refused: {str(error).replace(str(network), wanted.source)}") from error
        target = directory / wanted.name
        if target.exists():
            target.rename(scratch / "replaced")
        made.rename(target)
    return lines


def _manifest_text(wanted: Installation, network: Path, sha256: str, scratch: Path) -> tuple[str, str]:
    """Returns the manifest pinned to the network, and the SHA-256 that it was pinned to before ("": none)."""
    explicit = wanted.manifest
    beside = f"{wanted.source.removesuffix('.onnx')}.toml"
    by_hash = not explicit and any(sha256 in path.read_text() for path in shipped_manifests().values())
    if _is_address(explicit) or (wanted.remote and not explicit and not by_hash):
        fetched = scratch / "manifest.toml"
        _fetch(explicit or beside, fetched, MANIFEST_LIMIT_BYTES)
        explicit = str(fetched)
    elif not wanted.remote and not explicit and Path(beside).is_file():
        explicit = beside
    try:
        manifest, path = find_as(network, sha256, explicit, ManifestHeader)
    except ModelError as error:
        raise ModelError(f"refused: {str(error).replace(str(network), wanted.source)}") from error
    text = path.read_text()
    if not manifest.sha256:
        if "sha256" in tomllib.loads(text):
            text = re.sub(r"(?m)^\s*sha256\s*=.*$", "", text, count=1)
        text = f'sha256 = "{sha256}"\n{text}'
    return text, manifest.sha256


def _fetch(source: str, target: Path, limit_bytes: int) -> None:
    if _is_address(source):
        with Progress(target.stem, None, "MB", 1e6) as progress:

            def received(bytes_so_far: int, total_bytes: int | None) -> None:
                progress.total = total_bytes
                progress.reach(bytes_so_far)

            download(source, target, limit_bytes, TIMEOUT_S, received)
        return
    path = Path(source).expanduser()
    try:
        size_bytes = path.stat().st_size
        if size_bytes > limit_bytes:
            raise ModelError(f"{source}: {size_bytes} bytes are over the limit of {limit_bytes}")
        shutil.copyfile(path, target)
    except OSError as error:
        raise ModelError(f"{source}: the file can't be read: {error.strerror}") from error


def _is_address(text: str) -> bool:
    return urlsplit(text).scheme in SCHEMES


@contextlib.contextmanager
def _scratch(directory: Path) -> Iterator[Path]:
    """Creates a temporary directory beside the models, under a lock; removes those of killed commands."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with (directory / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            for left in directory.glob(f"{_SCRATCH}*"):
                shutil.rmtree(left)
            with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=directory) as scratch:
                yield Path(scratch)
    except OSError as error:
        raise ModelError(f"{directory}: can't install there: {error.strerror}") from error
