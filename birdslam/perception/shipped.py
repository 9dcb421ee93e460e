"""The networks of a single-process program: those that ship with the package, or others by their files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS, Role
from birdslam.perception.network import ModelSpec, load_network
from birdslam.perception.schedule import Networks


def shipped_networks() -> Networks:
    """The package's own network for vehicles, road, lane markings and depth. Raises ModelError.

    It was trained on rendered streets only; on real roads YOLOX and TwinLiteNet (`load_networks`) detect more.
    """
    return load_networks({"multitask": ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK))})


def load_networks(specs: Mapping[Role, ModelSpec]) -> Networks:
    """Loads a network for each role; they run one after the other in the caller's thread.

    Each ONNX file has a manifest, FILE.toml, next to it (docs/networks.md). Raises ModelError.
    """
    return Networks([load_network(role, spec) for role, spec in specs.items()], run_at_once)


def run_at_once(run: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """An executor for `Networks` that runs its task immediately; an exception is stored in the future."""
    done: Future[Any] = Future()
    try:
        done.set_result(run(*arguments))
    except Exception as error:  # a network's bug, which surfaces where the result is asked for
        done.set_exception(error)
    return done
