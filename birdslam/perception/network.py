"""One network: its file, manifest and onnxruntime session. `Network.run` returns the findings of an image."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, cast, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats32
from birdslam.perception.decoding.box_lists import BoxListDecoder, SsdDecoder
from birdslam.perception.decoding.centernet import CenterNetDecoder
from birdslam.perception.decoding.depth import DisparityDecoder, MetricDepthDecoder
from birdslam.perception.decoding.detection import YoloxDecoder
from birdslam.perception.decoding.multitask import OUTPUTS, Findings, MultiTaskDecoder
from birdslam.perception.decoding.row_anchors import RowAnchorsDecoder
from birdslam.perception.decoding.segmentation import ClassMapsDecoder
from birdslam.perception.manifest import (
    BoxList,
    CenterNet,
    ClassMaps,
    Count,
    Disparity,
    Manifest,
    ManifestMismatch,
    MetricDepth,
    ModelError,
    MultiTask,
    Role,
    RowAnchors,
    Schedule,
    Ssd,
    Yolox,
)
from birdslam.perception.manifest_file import find_manifest
from birdslam.perception.onnx_files.onnx_file import has_external_weights
from birdslam.perception.onnx_files.unread_outputs import without_outputs
from birdslam.perception.verge import without_verge
from birdslam.perception.views import Preparation, View, make_views

Provider = Literal["auto", "cpu", "openvino", "cuda", "tensorrt"]


class ModelSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A network in the configuration; None takes the manifest's value (see `manifest.Schedule`)."""

    path: str  # the ONNX file, or a model's name
    manifest: str = ""  # its TOML file, or the name of a shipped manifest; "": FILE.toml beside FILE.onnx
    every: Count | None = None  # frames between two runs
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] | None = None  # of the network
    awaited: bool | None = None  # whether a frame waits for it, up to its deadline
    provider: Provider | None = None  # execution provider; None: perceive.provider


class Decoder(Protocol):
    """Decodes a network's outputs to findings: `read` those of each view, then `merge` those of one image."""

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Any: ...

    def merge(self, parts: Any, views: Any) -> Any: ...


# The decodings: a manifest's table -> (decoder, the field of Findings that it fills, the outputs that it reads). Where
# the field is "" the decoder returns Findings itself. A decoder is called with (table, input, shapes of the outputs)
# and raises ManifestMismatch. A new decoding is a row here, its table in manifest.py and, for a new role, a field in
# Manifest and in Findings.
DECODINGS: dict[type, tuple[Callable[..., Decoder], str, Callable[[Any], tuple[str, ...]]]] = {
    Yolox: (YoloxDecoder, "detections", lambda table: (table.output,)),
    CenterNet: (
        CenterNetDecoder,
        "detections",
        lambda table: tuple(filter(None, (table.heat_map, table.sizes, table.offsets))),
    ),
    Ssd: (SsdDecoder, "detections", lambda table: (table.locations, table.scores, table.priors)),
    BoxList: (BoxListDecoder, "detections", lambda table: tuple(filter(None, (table.boxes, table.scores)))),
    Disparity: (DisparityDecoder, "depth", lambda table: (table.output,)),
    MetricDepth: (MetricDepthDecoder, "depth", lambda table: (table.output,)),
    ClassMaps: (ClassMapsDecoder, "segmentation", lambda table: tuple(dict.fromkeys(m.output for m in table.maps))),
    RowAnchors: (RowAnchorsDecoder, "segmentation", lambda table: (table.output,)),
    MultiTask: (MultiTaskDecoder, "", lambda table: OUTPUTS),
}


class _Bound:
    """A session whose input is `image` and whose output buffers are allocated once."""

    def __init__(self, session: Any, name: str, image: Floats32, outputs: Sequence[str]) -> None:
        self._session = session
        first = session.run(outputs, {name: image})  # the real shapes of the outputs
        self.tensors = {output: np.empty(out.shape, np.float32) for output, out in zip(outputs, first, strict=True)}
        self._name, self._image = name, image
        self._binding = session.io_binding()
        for output, buffer in self.tensors.items():
            self._binding.bind_output(output, "cpu", 0, np.float32, buffer.shape, buffer.ctypes.data)
        self.infer()  # warm-up of this path

    def infer(self) -> bool:
        """Runs on the input buffer; False if an output is not finite."""
        image = self._image  # bound again for each run: an accelerator copies the input when it is bound
        self._binding.bind_input(self._name, "cpu", 0, np.float32, image.shape, image.ctypes.data)
        self._session.run_with_iobinding(self._binding)
        self._binding.synchronize_outputs()
        return all(np.isfinite(tensor).all() for tensor in self.tensors.values())


class Network:
    """A loaded and warmed-up network. Not reentrant: the buffers are allocated once.

    Attributes: `name` of the head, `role`, `sha256` of the file, `manifest`, `schedule` in force, `decoder`.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        manifest: Manifest,
        sha256: str,
        content: bytes,
        schedule: Schedule,
        unread: Collection[str] = (),
        apart: Collection[str] = (),
        provider: str = "cpu",
    ) -> None:
        """Outputs `unread` are not computed; `run_without` also leaves out those in `apart`.

        If the `provider` is missing or fails later, the CPU replaces it and `fell_back` holds the reason. Raises
        ManifestMismatch if manifest and network disagree, an onnxruntime error if the network cannot run.
        """
        self.name = name
        self.role: Role = manifest.role
        self.path = path
        self.manifest = manifest
        self.sha256 = sha256
        self.schedule = schedule
        table = getattr(manifest, manifest.role)
        make_decoder, self._finding, outputs_of = DECODINGS[type(table)]
        self._outputs = tuple(output for output in outputs_of(table) if output not in unread)
        self._preparation = Preparation(manifest.input)
        # Imported here: onnxruntime takes 18 MB
        from birdslam.perception.session import SESSION_ERRORS, ProviderMissing, open_session

        self.fell_back = ""  # the reason why the CPU replaces the requested provider

        def bound(left_out: Collection[str]) -> _Bound:
            outputs = tuple(output for output in self._outputs if output not in left_out)
            part = without_outputs(content, {*unread, *left_out}) if unread or left_out else content
            session = open_session(part, manifest.input, outputs, schedule.threads, self.provider)
            return _Bound(session, manifest.input.name, self._preparation.tensor, outputs)

        def bind() -> None:
            self._whole = bound(())
            self._part = bound(apart) if apart else self._whole

        self.provider, self._bind = provider, bind
        try:
            bind()
        except ProviderMissing as error:
            self._fall_back(error)
        except SESSION_ERRORS as error:
            if provider == "cpu":
                raise
            self._fall_back(error)
        shapes = {output: tensor.shape for output, tensor in self._whole.tensors.items()}
        self.decoder = make_decoder(table, manifest.input, shapes)
        self._views: dict[tuple[int, int], tuple[View, ...]] = {}

    def _fall_back(self, error: Exception) -> None:
        self.fell_back = f"{self.provider}: {' '.join(str(error).split())}"
        self.provider = "cpu"
        self._bind()

    def _run_session(self, apart: bool = False) -> _Bound | None:
        """Runs on the input; None if an output is not finite. A run that fails on an accelerator repeats on the CPU."""
        from birdslam.perception.session import SESSION_ERRORS

        try:
            bound = self._part if apart else self._whole
            return bound if bound.infer() else None
        except SESSION_ERRORS as error:
            if self.provider == "cpu":
                raise
            self._fall_back(error)
            return self._run_session(apart)

    def views(self, image: NDArray[np.uint8]) -> tuple[View, ...]:
        """The views of an image, one run each. Raises ValueError if it is not an image."""
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise ValueError(
                f"{self.name}: needs a grey (H, W) or BGR (H, W, 3) uint8 image, got {image.dtype} {image.shape}"
            )
        height_px, width_px = image.shape[:2]
        if (height_px, width_px) not in self._views:
            if min(height_px, width_px) < 1:
                raise ValueError(f"{self.name}: an image of {width_px}x{height_px} has no pixels")
            self._views[height_px, width_px] = make_views(width_px, height_px, self.manifest.input, self.manifest.tiles)
        return self._views[height_px, width_px]

    def prepare(self, image: NDArray[np.uint8], view: View) -> None:
        """Writes a view of the image into the network's input."""
        self._preparation.fill(image, view)

    def infer(self) -> bool:
        """Runs the network on its input; False if an output is not finite."""
        return self._run_session() is not None

    def read(self, view: View) -> Any:
        """The decoded outputs of the last run, for `merge`."""
        return self.decoder.read(self._whole.tensors, view)

    def run(self, image: NDArray[np.uint8]) -> Findings | None:
        """The findings in a grey (H, W) or BGR (H, W, 3) image of any size; None if an output is not finite."""
        return self._run(image)

    def run_without(self, image: NDArray[np.uint8]) -> Findings | None:
        """As `run`, bit-identical, without the outputs in `apart` and the nodes that only they need."""
        return self._run(image, apart=True)

    def _run(self, image: NDArray[np.uint8], apart: bool = False) -> Findings | None:
        views, parts = self.views(image), []
        for view in views:
            self.prepare(image, view)
            bound = self._run_session(apart)
            if bound is None:
                return None
            parts.append(self.decoder.read(bound.tensors, view))
        merged = self.decoder.merge(parts, views)
        found = Findings(**{self._finding: merged}) if self._finding else cast(Findings, merged)
        masks = found.segmentation
        if masks is None:
            return found
        return replace(found, segmentation=replace(masks, road=without_verge(masks.road, image)))

    def raw_outputs(self, image: NDArray[np.uint8]) -> dict[str, Floats32]:
        """The raw outputs for an image's first view."""
        self.prepare(image, self.views(image)[0])
        self.infer()
        return {name: tensor.copy() for name, tensor in self._whole.tensors.items()}

    @property
    def output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the outputs that the manifest names."""
        return {name: tensor.shape for name, tensor in self._whole.tensors.items()}

    def describe(self) -> dict[str, Any]:
        """The network's settings as plain values, for a summary."""
        from birdslam.perception.session import onnxruntime_version

        return {
            "name": self.name,
            "role": self.role,
            "title": self.manifest.title,
            "file": self.path.name,
            "sha256": self.sha256,
            "input_px": [self.manifest.input.width_px, self.manifest.input.height_px],
            "tiles": self.manifest.tiles.columns if self.manifest.tiles else 1,
            "every": self.schedule.every,
            "threads": self.schedule.threads,
            "awaited": self.schedule.awaited,
            "provider": self.provider,
            "onnxruntime": onnxruntime_version(),
        }


def load_network(
    name: str,
    spec: ModelSpec,
    max_threads: int | None = None,
    unread: Collection[str] = (),
    apart: Collection[str] = (),
) -> Network:
    """Opens a network, checks its manifest against its real inputs and outputs, and warms it up.

    Without `threads` in the `spec`, the manifest's count applies, limited to `max_threads`. A multi-task network does
    not compute the outputs in `unread` (only "depth" is allowed); `run_without` also leaves out those in `apart` (only
    "segmentation" is allowed). Provider "auto" is the CPU here; runtime/models/providers.py measures the fastest one.
    If `name` is a role, the manifest must have the same role. Raises ModelError, which names the file, the key and both
    values.
    """
    path = Path(spec.path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: the network can't be read: {error.strerror}") from error
    sha256 = hashlib.sha256(content).hexdigest()
    manifest, origin = find_manifest(path, sha256, spec.manifest)
    if name in get_args(Role) and name != manifest.role:
        raise ModelError(f"{path}: role: the manifest {origin} says {manifest.role}, but the network is used as {name}")
    stated = {key: value for key in ("every", "threads", "awaited") if (value := getattr(spec, key)) is not None}
    schedule = msgspec.structs.replace(manifest.schedule, **stated)
    if max_threads is not None and spec.threads is None:
        schedule = msgspec.structs.replace(schedule, threads=min(schedule.threads, max_threads))
    check_weights_are_inside(path, content)
    from birdslam.perception.session import SESSION_ERRORS

    try:
        outputs = (unread, apart) if manifest.role == "multitask" else ((), ())
        provider = "cpu" if spec.provider in (None, "auto") else str(spec.provider)
        return Network(name, path, manifest, sha256, content, schedule, *outputs, provider)
    except ManifestMismatch as error:
        raise ModelError(f"{path}: {error} (manifest {origin})") from error
    except SESSION_ERRORS as error:
        raise ModelError(f"{path}: onnxruntime can't run this network: {error}") from error


def check_weights_are_inside(path: Path, content: bytes) -> None:
    """Raises ModelError if weights are in another file: the network's SHA-256 would not cover them."""
    try:
        elsewhere = has_external_weights(content)
    except ValueError as error:
        raise ModelError(f"{path}: onnxruntime can't run this network: {error}") from error
    if elsewhere:
        raise ModelError(f"{path}: its weights are in another file (external data); save the network as one file")
