"""`birdslam models`: lists, checks and installs networks."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.perception import ModelError
from birdslam.runtime.models import store
from birdslam.runtime.models.catalogue import catalogue
from birdslam.runtime.models.examine import examine, read_header
from birdslam.runtime.models.install import install, installation_of


def add_directory(parser: argparse.ArgumentParser) -> None:
    """Adds the directory of installed models."""
    parser.add_argument("--directory", type=Path, metavar="DIR", help="directory of installed models (models_dir)")


def list_models(options: argparse.Namespace) -> int:
    """`birdslam models list`: prints a row per network; an unusable one states the reason."""
    directory = store.models_directory(options.directory)
    rows = [("name", "from", "role", "MB", "description")]
    available = {name: ("shipped", path) for name, path in store.shipped().items()}
    available |= {name: ("installed", path) for name, path in store.installed(directory).items()}
    for name, (origin, network) in available.items():
        size = f"{network.stat().st_size / 1e6:.1f}"
        try:
            head = read_header(network)
            rows.append((name, origin, head.role, size, head.title))
        except ModelError as error:
            rows.append((name, origin, "", size, f"unusable: {error}"))
    for name, entry in catalogue().models.items():
        if name not in available:
            text = f"{entry.title}; {entry.licence}; birdslam models add {name}"
            rows.append((name, "catalogue", "", f"{entry.size_bytes / 1e6:.1f}", text))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    for row in rows:
        print("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]))
    print(f"installed in {directory}")
    return 0


def add_check_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the network and its manifest."""
    parser.add_argument("file", metavar="FILE", help="a network (.onnx), its manifest (.toml), or the name of a model")
    parser.add_argument("--manifest", default="", metavar="FILE|NAME", help="manifest, if not beside the network")
    add_directory(parser)


def check(options: argparse.Namespace) -> int:
    """`birdslam models check`: prints the inputs and outputs of a network and the result of a test run."""
    text: str = options.file
    if store.is_name(text) and not Path(text).exists():
        text = str(store.find(text, options.directory))
    network, manifest = Path(text), options.manifest
    if network.suffix == ".toml":
        network, manifest = network.with_suffix(".onnx"), str(network)
    print("\n".join(examine(network, manifest)))
    return 0


def add_install_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds networks, manifest, checksum, name and size limit."""
    parser.add_argument("sources", nargs="+", metavar="NAME|PATH|URL", help="name in the catalogue, or an .onnx file")
    text = "manifest (.toml), if not beside the network"
    parser.add_argument("--manifest", default="", metavar="FILE|NAME", help=text)
    text = "checksum of the network; required for a URL unless the catalogue has it"
    parser.add_argument("--sha256", default="", metavar="HEX", help=text)
    parser.add_argument("--name", default="", metavar="NAME", help="name of the installed model; default: file name")
    parser.add_argument("--limit-mb", type=float, default=500.0, metavar="MB", help="maximum size of a file")
    add_directory(parser)


def add(options: argparse.Namespace) -> int:
    """`birdslam models add`: installs networks until the first failure."""
    if len(options.sources) > 1 and (options.name or options.sha256 or options.manifest):
        raise ModelError("--name, --sha256 and --manifest apply to one network: add one network at a time")
    directory = store.models_directory(options.directory)
    limit_bytes = round(options.limit_mb * 1e6)
    for source in options.sources:
        wanted = installation_of(source, options.name, options.manifest, options.sha256, limit_bytes)
        lines = install(wanted, directory)
        print(f"installed {wanted.name} in {directory / wanted.name}: birdslam run --model {wanted.name}")
        print("\n".join(lines[1:]))
    return 0
