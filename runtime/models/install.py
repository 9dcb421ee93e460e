"""Installing networks by name: from the catalogue, a file or an address.

An installed network is whole and fits, or nothing of it is there: it is fetched, checked and run in a scratch
directory, which becomes the model's own by one renaming. Nothing of a model is ever executed but its graph, by
onnxruntime.
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
    """One network to be installed: its name, where it is had from, and what it must be."""

    name: str
    source: str  # a path, or an http(s) address
    manifest: str  # a path, an address, the name of a shipped one; "": found as for any network
    sha256: str  # "": what the manifest pins, or for a file of this machine what it has
    limit_bytes: int

    @property
    def remote(self) -> bool:
        """Whether it comes over the network."""
        return _is_address(self.source)


def installation_of(source: str, name: str, manifest: str, sha256: str, limit_bytes: int) -> Installation:
    """What one argument of `models add` asks for. Raises ModelError."""
    if sha256 and not re.fullmatch("[0-9a-f]{64}", sha256.lower()):
        raise ModelError(f"--sha256 {sha256}: 64 hexadecimal digits are needed")
    if name and not model_store.is_name(name):
        raise ModelError(f"--name {name}: letters, digits, _ . - are needed, no .onnx at its end")
    if model_store.is_name(source) and not Path(source).is_file():
        known = catalogue()
        if source not in known.models:
            raise ModelError(f"no model {source!r} in the catalogue, which has {', '.join(known.models)}; no such file")
        entry = known.models[source]
        if sha256 and sha256.lower() != entry.sha256:
            raise ModelError(f"{source}: --sha256 {sha256} is not the catalogue's {entry.sha256}")
        size_bytes, address = min(entry.size_bytes, limit_bytes), known.address_of(entry)
        manifest = manifest or entry.manifest
        return Installation(name or source, address, manifest, entry.sha256, size_bytes)
    if source.endswith((".xml", ".bin")):
        raise ModelError(
            f"{source}: an OpenVINO IR is not read; convert it to ONNX with OpenVINO's tools, name that file"
        )
    stem = Path(urlsplit(source).path if _is_address(source) else source).stem
    if not name and not model_store.is_name(stem):
        raise ModelError(f"{source}: {stem!r} is no name for a model: state one by --name")
    return Installation(name or stem, source, manifest, sha256.lower(), limit_bytes)


def install(wanted: Installation, directory: Path) -> list[str]:
    """Fetches, checks and installs one network; gives what `examine` says of it.

    Raises ModelError or DownloadError, and then leaves nothing behind.
    """
    with _scratch(directory) as scratch:
        made = scratch / wanted.name
        made.mkdir()
        network = made / f"{wanted.name}.onnx"
        _fetch(wanted.source, network, wanted.limit_bytes)
        has = hashlib.sha256(network.read_bytes()).hexdigest()
        if wanted.sha256 and has != wanted.sha256:
            raise ModelError(f"{wanted.source}: SHA-256 {has}, but {wanted.sha256} was expected: refused")
        text, pinned = _manifest_text(wanted, network, has, scratch)
        if wanted.remote and not wanted.sha256 and pinned != has:
            raise ModelError(f"{wanted.source}: no SHA-256 is known for it: state it by --sha256 or in its manifest")
        network.with_suffix(".toml").write_text(text)
        try:
            lines = examine(network, "")
        except ModelError as error:  # named by where it came from, not by a place that is about to vanish
            raise ModelError(f"refused: {str(error).replace(str(network), wanted.source)}") from error
        target = directory / wanted.name
        if target.exists():
            target.rename(scratch / "replaced")
        made.rename(target)
    return lines


def _manifest_text(wanted: Installation, network: Path, sha256: str, scratch: Path) -> tuple[str, str]:
    """The manifest to install, pinned to the network, and the SHA-256 that it was pinned to before ("": to none)."""
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
    """A directory beside the models that is gone afterwards, with what a killed `add` has left; one `add` at a time."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with (directory / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            for left in directory.glob(f"{_SCRATCH}*"):
                shutil.rmtree(left)
            with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=directory) as scratch:
                yield Path(scratch)
    except OSError as error:
        raise ModelError(f"{directory}: nothing can be installed there: {error.strerror}") from error
