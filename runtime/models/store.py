"""Networks by name: those of the package, and those installed by `birdslam models add`.

An installed model is a directory NAME with NAME.onnx and the manifest NAME.toml, which pins the network's SHA-256. The
models directory is `runtime.models_dir`, else `$XDG_DATA_HOME/birdslam/models`, else `~/.local/share/birdslam/models`.
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
    """Returns the models directory, which need not exist. Raises ModelError if it can't be determined."""
    if configured:
        return Path(configured).expanduser()
    data_home = os.environ.get("XDG_DATA_HOME")
    if data_home:
        return Path(data_home, "birdslam", "models")
    home = os.environ.get("HOME")
    if not home:
        raise ModelError("no models directory: set runtime.models_dir, XDG_DATA_HOME or HOME")
    return Path(home, ".local", "share", "birdslam", "models")


def is_name(text: str) -> bool:
    """Whether the text is a model's name, not a path."""
    return _NAME.fullmatch(text) is not None and Path(text).suffix not in (".onnx", ".toml")


def installed(directory: Path) -> dict[str, Path]:
    """Returns name -> network of the installed models, sorted by name."""
    found = {path.name: path / f"{path.name}.onnx" for path in sorted(directory.glob("*")) if is_name(path.name)}
    return {name: network for name, network in found.items() if network.is_file()}


def shipped() -> dict[str, Path]:
    """Returns name -> network of the package's models, sorted by name."""
    return {path.stem: path for path in sorted(SHIPPED_NETWORKS.glob("*.onnx")) if path != COMPLETION}


def find(name: str, models_dir: str | Path | None) -> Path:
    """Returns the network of a name; an installed one overrides a shipped one. Raises ModelError if there is none."""
    at_hand = shipped()
    at_hand.update(installed(models_directory(models_dir)))
    if name not in at_hand:
        has = f"available are {', '.join(at_hand)}" if at_hand else "none is installed"
        raise ModelError(f"no model {name!r}: {has} (`birdslam models list` shows what can be added)")
    return at_hand[name]


def role_of(network: Path) -> str:
    """Returns the role in a network's manifest. Raises ModelError."""
    manifest, _ = find_as(network, hashlib.sha256(network.read_bytes()).hexdigest(), "", ManifestHeader)
    return manifest.role
