"""Checks whether a network matches its manifest: loads it as a run does, and runs it once on synthetic input."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.perception import ModelError, ModelSpec, Network, load_network
from birdslam.perception.manifest_file import ManifestHeader, find_as
from birdslam.perception.pointnet import PointNet, load_pointnet

TEST_IMAGE_PX = (720, 1280)
TEST_BOXES = 8


def examine(network: Path, manifest: str) -> list[str]:
    """Loads a network and runs it once on synthetic input; returns a report of a few lines. Raises ModelError."""
    role = read_header(network, manifest).role
    return _examine_frusta(network, manifest) if role == "pointnet" else _examine_images(network, manifest)


def _examine_images(network: Path, manifest: str) -> list[str]:
    model = load_network("", ModelSpec(str(network), manifest))
    image = np.random.default_rng(1).integers(0, 256, (*TEST_IMAGE_PX, 3), dtype=np.uint8)
    begun_ns = time.perf_counter_ns()
    found = model.run(image)
    took_ms = (time.perf_counter_ns() - begun_ns) / 1e6
    if found is None:
        raise ModelError(f"{network}: its outputs are not finite on a noise image")
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
        raise ModelError(f"{network}: its outputs are not finite on a point cloud")
    takes = model.manifest.points
    given = f"{takes.name}, {takes.count} points per box, {takes.layout}: {' '.join(takes.features)}"
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


def read_header(network: Path, manifest: str = "") -> ManifestHeader:
    """Reads role and title from the manifest, without loading the network. Raises ModelError."""
    try:
        content = network.read_bytes()
    except OSError as error:
        raise ModelError(f"{network}: the network can't be read: {error.strerror}") from error
    return find_as(network, hashlib.sha256(content).hexdigest(), manifest, ManifestHeader)[0]
