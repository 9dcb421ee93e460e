"""onnxruntime sessions. Imported only where networks run: the library takes 18 MB."""

from __future__ import annotations

import contextlib
import io

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from birdslam.perception.manifest import Input, ManifestMismatch
from birdslam.perception.onnx_files.subnormal import without_tiny_weights

SESSION_ERRORS: tuple[type[Exception], ...] = tuple(
    error for error in vars(ort_errors).values() if isinstance(error, type) and issubclass(error, Exception)
)
_START_ERRORS: tuple[type[Exception], ...] = (*SESSION_ERRORS, RuntimeError)  # the last: without TensorRT's libraries
CPU = "CPUExecutionProvider"
EXECUTION_PROVIDERS = {  # configuration -> onnxruntime; docs/networks.md lists the packages
    "cpu": CPU,
    "openvino": "OpenVINOExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
_QUIET = 4  # errors are raised; onnxruntime's logger would also print them
_NVIDIA = frozenset({"cuda", "tensorrt"})
_FLOAT32 = "tensor(float)"


def session_options(threads: int) -> ort.SessionOptions:
    """Options of all sessions: the number of threads, which sleep while they wait."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.enable_mem_pattern = False  # saves memory at the same speed
    options.log_severity_level = _QUIET
    return options


def onnxruntime_version() -> str:
    """Version of the installed onnxruntime package."""
    return str(ort.__version__)


class ProviderMissing(Exception):
    """The installed onnxruntime lacks the provider, or the provider does not start on this computer."""


def available_providers() -> tuple[str, ...]:
    """The EXECUTION_PROVIDERS of the installed onnxruntime, "cpu" first."""
    built = set(ort.get_available_providers())
    return tuple(name for name, theirs in EXECUTION_PROVIDERS.items() if theirs in built)


def _options_of(provider: str, threads: int) -> dict[str, str]:
    if provider != "openvino":
        return {}
    return {"device_type": "CPU", "num_of_threads": str(threads), "precision": "FP32"}


def _nvidia_libraries() -> str:
    """Loads CUDA's and cuDNN's libraries from pip's packages; returns onnxruntime's error text or ""."""
    if not hasattr(ort, "preload_dlls"):  # before 1.21
        return ""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        ort.preload_dlls()
    return " ".join(said.getvalue().split())


def plain_session(content: bytes, threads: int) -> ort.InferenceSession:
    """A session that is not checked against a manifest."""
    return ort.InferenceSession(content, session_options(threads), providers=[CPU])


def open_session(
    content: bytes, input: Input, outputs: tuple[str, ...], threads: int, provider: str = "cpu"
) -> ort.InferenceSession:
    """A session with a fixed input shape, checked against the manifest.

    Raises ProviderMissing and ManifestMismatch.
    """
    probe_options = session_options(1)
    probe_options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    probe = ort.InferenceSession(content, probe_options, providers=[CPU])
    has_inputs = [i.name for i in probe.get_inputs()]
    if has_inputs != [input.name]:
        raise ManifestMismatch("input.name", repr(input.name), f"the inputs {has_inputs}")
    (has,) = probe.get_inputs()
    if has.type != _FLOAT32:
        raise ManifestMismatch("input", f"{_FLOAT32} (all that manifests can say)", has.type)
    axes = {"N": 1, "C": 3, "H": input.height_px, "W": input.width_px}
    if len(has.shape) != 4:
        raise ManifestMismatch("input.layout", input.layout, f"the shape {has.shape}")
    options = session_options(threads)
    for axis, size in zip(input.layout, has.shape, strict=True):
        key = {"H": "input.height_px", "W": "input.width_px"}.get(axis, "input.layout")
        if isinstance(size, str):
            options.add_free_dimension_override_by_name(size, axes[axis])
        elif size is not None and size != axes[axis]:
            raise ManifestMismatch(key, f"{axis} = {axes[axis]} in {input.layout}", f"{size} in {has.shape}")
    has_outputs = {o.name: o.type for o in probe.get_outputs()}
    for output in outputs:
        if output not in has_outputs:
            raise ManifestMismatch("output", repr(output), f"the outputs {list(has_outputs)}")
        if has_outputs[output] != _FLOAT32:
            raise ManifestMismatch(
                "output", f"{output} as {_FLOAT32} (all that manifests can say)", has_outputs[output]
            )
    whole = without_tiny_weights(content)
    if provider == "cpu":
        return ort.InferenceSession(whole, options, providers=[CPU])
    if provider not in available_providers():
        raise ProviderMissing(f"the installed onnxruntime has {', '.join(available_providers())}, not {provider}")
    wanted = EXECUTION_PROVIDERS[provider]
    missing = _nvidia_libraries() if provider in _NVIDIA else ""
    ort.set_default_logger_severity(_QUIET)
    providers = [(wanted, _options_of(provider, threads)), CPU]
    try:
        session = ort.InferenceSession(whole, options, providers=providers, enable_fallback=0)
    except _START_ERRORS as error:
        raise ProviderMissing(f"{provider} does not start: {error}") from error
    if session.get_providers()[0] != wanted:  # onnxruntime falls back to the CPU
        raise ProviderMissing(f"{provider} does not start on this computer{missing and ': ' + missing}")
    return session
