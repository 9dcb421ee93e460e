"""`birdslam models`: what is at hand, whether a network fits its manifest, and the installing of networks.

An installed network is whole and fits, or nothing of it is there: it is fetched, checked and run in a scratch
directory, which becomes the model's own by one renaming. Nothing of a model is ever executed but its graph, by
onnxruntime.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import re
import shutil
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.perception import ModelError, ModelSpec, Network, load_network, shipped_manifests
from birdslam.perception.manifest_file import ManifestHeader, find_as
from birdslam.perception.pointnet import PointNet, load_pointnet
from birdslam.runtime.models import store as model_store
from birdslam.runtime.models.catalogue import Ir, catalogue, check_answers, converted
from birdslam.runtime.models.download import SCHEMES, download
from birdslam.runtime.progress import Progress

TIMEOUT_S = 30.0  # without a byte
MANIFEST_LIMIT_BYTES = 1 << 20
TEST_IMAGE_PX = (720, 1280)
TEST_BOXES = 8
_SCRATCH = ".adding-"


@dataclass(frozen=True)
class Order:
    """One network to be installed: as what, from where, and what it must be."""

    name: str
    source: str  # a path, or an http(s) address
    manifest: str  # a path, an address, the name of a shipped one; "": found as for any network
    sha256: str  # "": what the manifest pins, or for a file of this machine what it has
    limit_bytes: int
    ir: Ir | None = None  # where `source` is the XML of an OpenVINO IR

    @property
    def remote(self) -> bool:
        """Whether it comes over the network."""
        return _is_address(self.source)


def list_models(options: argparse.Namespace) -> int:
    """`birdslam models list`: a row for each network; one that can't be used says why."""
    directory = model_store.models_directory(options.directory)
    rows = [("name", "from", "role", "MB", "what")]
    at_hand = {**{n: ("shipped", p) for n, p in model_store.shipped().items()}}
    at_hand.update({n: ("installed", p) for n, p in model_store.installed(directory).items()})
    for name, (origin, network) in at_hand.items():
        rows.append((name, origin, *_row(network)))
    for name, entry in catalogue().models.items():
        if name not in at_hand:
            what = f"{entry.title}; {entry.licence}; birdslam models add {name}"
            rows.append((name, "catalogue", "", f"{entry.size_bytes / 1e6:.1f}", what))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]))
    print(f"installed in {directory}")
    return 0


def check(options: argparse.Namespace) -> int:
    """`birdslam models check`: what the network really takes and gives, and one test run. Raises ModelError."""
    text: str = options.file
    if model_store.is_name(text) and not Path(text).exists():
        text = str(model_store.find(text, options.directory))
    network, manifest = Path(text), options.manifest
    if network.suffix == ".toml":
        network, manifest = network.with_suffix(".onnx"), str(network)
    for line in examine(network, manifest):
        print(line)
    return 0


def add(options: argparse.Namespace) -> int:
    """`birdslam models add`: installs each; the first that can't be ends it. Raises ModelError, DownloadError."""
    if len(options.sources) > 1 and (options.name or options.sha256 or options.manifest):
        raise ModelError("--name, --sha256 and --manifest are of one network: add it alone")
    directory = model_store.models_directory(options.directory)
    for source in options.sources:
        order = order_of(source, options.name, options.manifest, options.sha256, round(options.limit_mb * 1e6))
        lines = install(order, directory)
        print(f"installed {order.name} in {directory / order.name}: birdslam run --model {order.name}")
        print("\n".join(lines[1:]))
    return 0


def order_of(source: str, name: str, manifest: str, sha256: str, limit_bytes: int) -> Order:
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
            raise ModelError(f"{source}: --sha256 {sha256} is not the catalogue's {entry.sha256 or 'own: it is made'}")
        if entry.ir is not None and manifest:
            raise ModelError(f"{source}: --manifest: it is made for the catalogue's own, {entry.manifest}")
        size_bytes, address = min(entry.size_bytes, limit_bytes), known.address_of(entry)
        manifest = manifest or entry.manifest
        return Order(name or source, address, manifest, entry.sha256 or "", size_bytes, entry.ir)
    stem = Path(urlsplit(source).path if _is_address(source) else source).stem
    if not name and not model_store.is_name(stem):
        raise ModelError(f"{source}: {stem!r} is no name for a model: state one by --name")
    return Order(name or stem, source, manifest, sha256.lower(), limit_bytes)


def install(order: Order, directory: Path) -> list[str]:
    """Fetches, checks and installs one network; gives what `examine` says of it.

    Raises ModelError or DownloadError, and then leaves nothing behind.
    """
    with _scratch(directory) as scratch:
        made = scratch / order.name
        made.mkdir()
        network = made / f"{order.name}.onnx"
        if order.ir is None:
            _fetch(order.source, network, order.limit_bytes)
        else:
            network.write_bytes(_fetch_ir(order, order.ir, scratch))
        has = hashlib.sha256(network.read_bytes()).hexdigest()
        if order.sha256 and has != order.sha256:
            raise ModelError(f"{order.source}: SHA-256 {has}, but {order.sha256} was expected: refused")
        text, pinned = _manifest_text(order, network, has, scratch)
        if order.remote and not order.sha256 and order.ir is None and pinned != has:
            raise ModelError(f"{order.source}: no SHA-256 is known for it: state it by --sha256 or in its manifest")
        network.with_suffix(".toml").write_text(text)
        try:
            lines = examine(network, "")
            if order.ir is not None:
                check_answers(order.ir, order.source, load_network("", ModelSpec(str(network))))
        except ModelError as error:  # named by where it came from, not by a place that is about to vanish
            raise ModelError(f"refused: {str(error).replace(str(network), order.source)}") from error
        target = directory / order.name
        if target.exists():
            target.rename(scratch / "replaced")
        made.rename(target)
    return lines


def examine(network: Path, manifest: str) -> list[str]:
    """Opens a network as a run would and runs it once on made input: a few lines on it. Raises ModelError."""
    role = _read_header(network, manifest).role
    return _examine_frusta(network, manifest) if role == "pointnet" else _examine_images(network, manifest)


def _examine_images(network: Path, manifest: str) -> list[str]:
    model = load_network("", ModelSpec(str(network), manifest))
    image = np.random.default_rng(1).integers(0, 256, (*TEST_IMAGE_PX, 3), dtype=np.uint8)
    begun_ns = time.perf_counter_ns()
    found = model.run(image)
    took_ms = (time.perf_counter_ns() - begun_ns) / 1e6
    if found is None:
        raise ModelError(f"{network}: its outputs hold numbers that are not finite on a noise image")
    takes = model.manifest.input
    given = f"{takes.name} {takes.width_px}x{takes.height_px}, {takes.layout}, {takes.colour}"
    return _fits(network, model, given, f"{took_ms:.1f} ms on a {TEST_IMAGE_PX[1]}x{TEST_IMAGE_PX[0]} image")


def _examine_frusta(network: Path, manifest: str) -> list[str]:
    model = load_pointnet(ModelSpec(str(network), manifest))
    near_m, far_m = (-1.0, -0.7, 9.0), (1.0, 0.7, 11.0)
    boxes = list(np.random.default_rng(1).uniform(near_m, far_m, (TEST_BOXES, 1000, 3)))
    camera = Camera(width_px=640, height_px=192, fx_px=400.0, fy_px=400.0, cx_px=320.0, cy_px=96.0, height_m=1.6)
    begun_ns = time.perf_counter_ns()
    found = model.locate(boxes, ["car"] * TEST_BOXES, camera)
    took_ms = (time.perf_counter_ns() - begun_ns) / 1e6
    if found is None:
        raise ModelError(f"{network}: its outputs hold numbers that are not finite on a cloud of points")
    takes = model.manifest.points
    given = f"{takes.name}, {takes.count} points a box, {takes.layout}: {' '.join(takes.features)}"
    return _fits(network, model, given, f"{took_ms:.1f} ms on {TEST_BOXES} boxes of points")


def _fits(network: Path, model: Network | PointNet, given: str, test_run: str) -> list[str]:
    return [
        f"{network} fits its manifest",
        f"  role      {model.role}: {model.manifest.title or '(no title)'}",
        f"  input     {given}",
        f"  outputs   {', '.join(f'{name} {shape}' for name, shape in model.output_shapes.items())}",
        f"  schedule  every {model.schedule.every} frames, {model.schedule.threads} threads",
        f"  test run  {test_run}, all numbers finite",
        f"  sha256    {model.sha256}",
    ]


def _read_header(network: Path, manifest: str = "") -> ManifestHeader:
    try:
        content = network.read_bytes()
    except OSError as error:
        raise ModelError(f"{network}: the network can't be read: {error.strerror}") from error
    return find_as(network, hashlib.sha256(content).hexdigest(), manifest, ManifestHeader)[0]


def _row(network: Path) -> tuple[str, str, str]:
    """Role, size and what it is, of the list; the network is not run."""
    size = f"{network.stat().st_size / 1e6:.1f}"
    try:
        manifest = _read_header(network)
    except ModelError as error:
        return "", size, f"unusable: {error}"
    return manifest.role, size, manifest.title


def _manifest_text(order: Order, network: Path, sha256: str, scratch: Path) -> tuple[str, str]:
    """The manifest to install, pinned to the network, and the SHA-256 that it was pinned to before ("": to none)."""
    explicit = order.manifest
    beside = f"{order.source.removesuffix('.onnx')}.toml"
    by_hash = not explicit and any(sha256 in path.read_text() for path in shipped_manifests().values())
    if _is_address(explicit) or (order.remote and not explicit and not by_hash):
        fetched = scratch / "manifest.toml"
        _fetch(explicit or beside, fetched, MANIFEST_LIMIT_BYTES)
        explicit = str(fetched)
    elif not order.remote and not explicit and Path(beside).is_file():
        explicit = beside
    try:
        manifest, path = find_as(network, sha256, explicit, ManifestHeader)
    except ModelError as error:
        raise ModelError(f"refused: {str(error).replace(str(network), order.source)}") from error
    text = path.read_text()
    if not manifest.sha256:
        if "sha256" in tomllib.loads(text):
            text = re.sub(r"(?m)^\s*sha256\s*=.*$", "", text, count=1)
        text = f'sha256 = "{sha256}"\n{text}'
    return text, manifest.sha256


def _fetch_ir(order: Order, ir: Ir, scratch: Path) -> bytes:
    """The network of an IR: its XML and the .bin beside it fetched and converted."""
    parts = scratch / "network.xml", scratch / "network.bin"
    for part in parts:
        _fetch(f"{order.source.removesuffix('.xml')}{part.suffix}", part, order.limit_bytes)
    xml, weights = (part.read_bytes() for part in parts)
    return converted(ir, order.source, order.manifest, xml, weights)


def _fetch(source: str, target: Path, limit_bytes: int) -> None:
    if _is_address(source):
        with Progress(target.stem, None, "MB", 1e6) as progress:

            def got(got_bytes: int, total_bytes: int | None) -> None:
                progress.total = total_bytes
                progress.reach(got_bytes)

            download(source, target, limit_bytes, TIMEOUT_S, got)
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
