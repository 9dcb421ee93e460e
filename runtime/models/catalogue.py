"""The catalogue of networks that `birdslam models add NAME` knows, and how one is had that is published as an IR.

Of such a network nobody has stated the hash of its files; what is known is the network that they hold. So its weights
are pinned after the conversion, and what it answers to an image.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.perception import ModelError, Network, shipped_manifests
from birdslam.perception.manifest_file import read_manifest
from birdslam.perception.onnx_files.openvino_ir import IrError
from birdslam.perception.onnx_files.openvino_onnx import convert, weights_sha256

CATALOGUE = Path(__file__).parent / "catalogue.toml"
ANSWER_REL = 1e-3  # of an output's root mean square: CPUs round differently

Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class Ir(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a network is made of an OpenVINO IR, whose numbers lie beside its XML (.bin), and what must come out."""

    outputs: tuple[str, ...] = ()  # names for its results; those of a DetectionOutput have theirs
    weights_sha256: Sha256  # of its weights as float32, see openvino_onnx.weights_sha256
    answers: dict[str, tuple[float, float]]  # see `answers`


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A network of the catalogue: a file of a public repository at one commit, an ONNX file or the XML of an IR."""

    title: str
    manifest: str  # the name of a shipped one
    repository: str
    commit: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{40}$")]
    path: str
    sha256: Sha256 | None = None  # of the file; None: of an IR
    ir: Ir | None = None
    size_bytes: Annotated[int, msgspec.Meta(ge=1)]  # of the file; of an IR at the most, of each of its two
    licence: str

    def __post_init__(self) -> None:
        if (self.sha256 is None) == (self.ir is None):
            raise ValueError("sha256 or ir: one of them says what is pinned")
        if self.ir is not None and not self.path.endswith(".xml"):
            raise ValueError(f"path: an IR is an .xml, got {self.path}")


class Catalogue(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The networks that can be added by name; `address` makes an URL of an entry."""

    address: str
    models: dict[str, Entry]

    def address_of(self, entry: Entry) -> str:
        """Where the entry's network lies."""
        return self.address.format(repository=entry.repository, commit=entry.commit, path=entry.path)


def catalogue() -> Catalogue:
    """What the package's catalogue holds."""
    return msgspec.toml.decode(CATALOGUE.read_bytes(), type=Catalogue)


def converted(ir: Ir, source: str, manifest: str, xml: bytes, weights: bytes) -> bytes:
    """The network of an IR as ONNX, for the input of a shipped manifest. Raises ModelError where it is another."""
    size = read_manifest(shipped_manifests()[manifest]).input
    try:
        network = convert(xml, weights, size.width_px, size.height_px, ir.outputs)
        has = weights_sha256(network)
    except ImportError as error:
        raise ModelError(
            f"{source}: an OpenVINO IR needs the extra `models`: pip install 'birdslam[models]'"
        ) from error
    except IrError as error:
        raise ModelError(f"{source}: {error}") from error
    if has != ir.weights_sha256:
        raise ModelError(f"{source}: its weights have the SHA-256 {has}, but {ir.weights_sha256} was expected: refused")
    return network


def check_answers(ir: Ir, source: str, network: Network) -> None:
    """Raises ModelError where a network with the right weights, wired otherwise, does not answer as the pinned one."""
    for name, has in answers(network).items():
        pinned = ir.answers.get(name, (math.nan, math.nan))
        if not all(abs(a - b) <= ANSWER_REL * abs(b) for a, b in zip(has, pinned, strict=True)):
            said = f"on the probing image {name} is {has[0]:.6g}, {has[1]:.6g}"
            raise ModelError(f"{source}: {said}, but {pinned[0]}, {pinned[1]} was expected: refused")


def answers(network: Network) -> dict[str, tuple[float, float]]:
    """Of each output on the probing image: the root mean square of its numbers, and of the steps between them."""
    out = {}
    for name, numbers in network.answer(probing_image()).items():
        flat = numbers.ravel().astype(np.float64)
        out[name] = (float(np.sqrt(np.mean(flat**2))), float(np.sqrt(np.mean(np.diff(flat) ** 2))))
    return out


def probing_image() -> NDArray[np.uint8]:
    """(720, 1280, 3): waves, edges and a fine pattern, the same everywhere."""
    y, x = np.mgrid[0:720, 0:1280]
    waves = (
        128.0 + 60.0 * np.sin(x / 97.0) * np.cos(y / 61.0) + 40.0 * ((x // 160 + y // 120) % 2) + (x * 7 + y * 13) % 27
    )
    return np.stack([waves, waves[:, ::-1], 255.0 - waves], axis=-1).clip(0.0, 255.0).astype(np.uint8)
