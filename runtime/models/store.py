"""Networks by name: those that the package ships, and those that `birdslam models add` has installed.

An installed model is a directory of its name with NAME.onnx, and its manifest NAME.toml, which pins the network's
SHA-256. The models directory is `$XDG_DATA_HOME/birdslam/models` (`~/.local/share/birdslam/models` where there is no
such variable) unless `runtime.models_dir` says otherwise.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from birdslam.perception.completion import SHIPPED as COMPLETION
from birdslam.perception.manifest import SHIPPED_NETWORKS, ModelError
from birdslam.perception.manifest_file import ManifestHeader, find_as

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def models_directory(configured: str | Path | None = None) -> Path:
    """Where models are installed; it need not exist. Raises ModelError where nothing says where."""
    if configured:
        return Path(configured).expanduser()
    data_home = os.environ.get("XDG_DATA_HOME")
    if data_home:
        return Path(data_home, "birdslam", "models")
    home = os.environ.get("HOME")
    if not home:
        raise ModelError("runtime.models_dir: neither it nor XDG_DATA_HOME nor HOME says where models are installed")
    return Path(home, ".local", "share", "birdslam", "models")


def is_name(text: str) -> bool:
    """Whether this is a model's name, and no path of a file."""
    return _NAME.fullmatch(text) is not None and Path(text).suffix not in (".onnx", ".toml")


def installed(directory: Path) -> dict[str, Path]:
    """Name -> network of the installed models, in order of name."""
    found = {path.name: path / f"{path.name}.onnx" for path in sorted(directory.glob("*")) if is_name(path.name)}
    return {name: network for name, network in found.items() if network.is_file()}


def shipped() -> dict[str, Path]:
    """Name -> network of those inside the package, in order of name."""
    return {path.stem: path for path in sorted(SHIPPED_NETWORKS.glob("*.onnx")) if path != COMPLETION}


def find(name: str, models_dir: str | Path | None) -> Path:
    """The network of a name; an installed one stands before a shipped one. Raises ModelError where there is none."""
    at_hand = shipped()
    at_hand.update(installed(models_directory(models_dir)))
    if name not in at_hand:
        has = f"at hand are {', '.join(at_hand)}" if at_hand else "none is at hand"
        raise ModelError(f"no model {name!r}: {has} (`birdslam models list` shows what can be added)")
    return at_hand[name]


def role_of(network: Path) -> str:
    """The role that a network's manifest states. Raises ModelError."""
    manifest, _ = find_as(network, hashlib.sha256(network.read_bytes()).hexdigest(), "", ManifestHeader)
    return manifest.role
