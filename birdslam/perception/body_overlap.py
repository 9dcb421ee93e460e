"""The bodies that one network finds, for the boxes of another: each box has that of the box which overlaps it most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from birdslam.perception.boxes3d import Boxes3d
from birdslam.perception.decoding.detection import Detections, intersections

LEAST_IOU = 0.5  # of two boxes on one object, as of a match in most benchmarks


def with_bodies(detections: Detections, others: Detections | None) -> Detections:
    """The detections (N) with the bodies of `others`, which are of the same image.

    A box that none of them overlaps by half has a body of which nothing is known: its sigmas are infinite. Detections
    with bodies of their own stay as they are.
    """
    if others is None or others.boxes3d is None or detections.boxes3d is not None:
        return detections
    n, bodies = len(detections), others.boxes3d
    if not n or not len(bodies):
        return detections
    shared = intersections(np.concatenate([detections.boxes_px, others.boxes_px]))
    area = np.diagonal(shared)
    both = shared[:n, n:]
    overlap = both / np.maximum(area[:n, None] + area[None, n:] - both, 1e-9)
    best = overlap.argmax(axis=1)
    return replace(detections, boxes3d=_known_where(bodies.take(best), overlap[np.arange(n), best] >= LEAST_IOU))


def _known_where(bodies: Boxes3d, known: NDArray[np.bool_]) -> Boxes3d:
    return replace(
        bodies,
        sigma_depth_m=np.where(known, bodies.sigma_depth_m, np.inf),
        sigma_size_m=np.where(known[:, None], bodies.sigma_size_m, np.inf),
        sigma_alpha_rad=np.where(known, bodies.sigma_alpha_rad, np.inf),
        flip=np.where(known, bodies.flip, 0.5),
    )
