"""Estimates the lens of a video without camera data from its images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.calibration import CalibrationError
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.calibration.lens import WIDE_SIGMA_REL, k1_by_bend, self_calibrate
from birdslam.calibration.lens_adjustment import IMAGES, SIGMA_K1
from birdslam.calibration.lens_windows import CornersOfImage, track_corners
from birdslam.calibration.travel import TravelPitch
from birdslam.calibration.vertical_edges import (
    MAX_IMAGES,
    LensByVerticalEdges,
    find_vertical_edges,
    lens_by_vertical_edges,
)
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.runtime.calibration.given import FocalLength, Given, focal_length_of
from birdslam.runtime.calibration.height import UNKNOWN_HEIGHT_M
from birdslam.runtime.calibration.pieces import READ_S, pieces, read_pieces
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import open_recorded
from birdslam.types import NS_PER_S

DETECTIONS_HZ = 8.0  # min. rate of the detector beside the tracking of corners


class LensOfDrive(NamedTuple):
    """A lens, the corners behind it, and the pitch from the direction of travel if observable."""

    lens: Intrinsics
    corners: list[CornersOfImage]
    pitch: TravelPitch | None = None


def lens_of_drive(
    configuration: Configuration, uri: str, given: Given, size_px: tuple[int, int], stride: int, must_show: bool = True
) -> LensOfDrive:
    """Estimates the lens of a video from its images.

    Raises CalibrationError if they do not determine it; without `must_show` it then returns the prior.
    """
    width_px, height_px = size_px
    known = focal_length_of(given, uri, size_px)
    focal_px = known.px
    middle = 0.5 * (width_px - 1.0), 0.5 * (height_px - 1.0)
    camera = Camera(width_px, height_px, focal_px, focal_px, *middle, height_m=given.height_m or UNKNOWN_HEIGHT_M)
    edges: list[Floats] = []
    corners = corners_of_drive(configuration, uri, camera, stride, edges)
    vertical = lens_by_vertical_edges(edges)
    known = focal_by_vertical_edges(known, vertical, width_px)
    focal_px, sigma_rel, by = known.px, known.sigma_rel, known.by
    bend = None if vertical is None or known.fisheye else (vertical.bend, vertical.bend_sigma)
    lens = self_calibrate(corners, size_px, focal_px, sigma_rel, known.by_view, known.fisheye, bend)
    if lens is None and not must_show and len(corners) >= IMAGES:
        k1 = 0.0 if bend is None else k1_by_bend(bend, focal_px / width_px)[0]
        shape = (
            "equidistant" if known.fisheye else "no distortion" if bend is None else f"k1 {k1:+.3f} from vertical edges"
        )
        assumed = Intrinsics(
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=middle[0],
            cy_px=middle[1],
            distortion=(k1, 0.0, 0.0, 0.0) if known.fisheye or bend is not None else (),
            fisheye=known.fisheye,
            width_px=width_px,
            height_px=height_px,
            source=f"assumed, not determined by the drive: focal length {focal_px:.0f} px +- {sigma_rel:.0%}, "
            f"{by}; {shape}",
            sigma_focal_px=focal_px * sigma_rel,
            distortion_sigma=SIGMA_K1,
        )
        return LensOfDrive(assumed, corners)
    if lens is None:
        raise CalibrationError(
            f"{uri}: its images do not determine the lens: the car hardly moves in the {READ_S:g} s that are read, or "
            "the images have too little texture; name a lens with --intrinsics, --chessboard or --camera"
        )
    focal = f"focal length {lens.focal_px:.0f} px +- {lens.focal_sigma_rel:.0%}"
    lines = f", {vertical.edges} vertical edges" if bend is not None and vertical is not None else ""
    shown = "by the drive" if lens.focal_shown else f"{by}; the drive turns too little to estimate it"
    found = Intrinsics(
        fx_px=lens.focal_px,
        fy_px=lens.focal_px,
        cx_px=middle[0],
        cy_px=middle[1],
        distortion=(lens.k1, 0.0, 0.0, 0.0),
        fisheye=lens.fisheye,
        width_px=width_px,
        height_px=height_px,
        source=(
            f"the drive: {focal}, {shown}; k1 {lens.k1:+.3f} +- {lens.k1_sigma:.3f} "
            f"(of {lens.windows} windows, {np.degrees(lens.turned_rad):.0f} deg turned{lines})"
        ),
        sigma_focal_px=lens.focal_px * lens.focal_sigma_rel,
        distortion_sigma=lens.k1_sigma,
    )
    return LensOfDrive(found, corners, lens.pitch)


def corners_of_drive(
    configuration: Configuration, uri: str, camera: Camera, stride: int, edges: list[Floats] | None = None
) -> list[CornersOfImage]:
    """Tracks corners in a video's raw images, outside vehicles; appends vertical edges of some images to `edges`."""
    configuration = configuration.as_lossless()
    raw = msgspec.structs.replace(camera, distortion=(), fisheye=False)
    recording = open_recorded(uri, raw, stride, configuration.source.topics)
    read = pieces(recording, configuration.source.frames)
    every = max(1, sum(map(len, read)) // MAX_IMAGES)
    with Inference(complete(configuration, raw, recording.rate_hz), boxes_only=True) as inference:
        inference.networks.slowdown = max(1, int(recording.rate_hz / DETECTIONS_HZ))

        def images() -> Iterator[tuple[NDArray[np.uint8], Floats | None, float]]:
            frames = read_pieces(recording, read, "lens")
            for index, (frame, pending) in enumerate(inference.networks.in_order(frames)):
                if frame.image is not None:
                    if edges is not None and index % every == 0:
                        edges.append(find_vertical_edges(frame.image))
                    found = pending.result()
                    detections = found.detections if found.ages.get("detector") == 0 else None
                    boxes_px = None if detections is None else detections.boxes_px
                    yield frame.image, boxes_px, frame.t_source_ns / NS_PER_S

        return track_corners(images(), raw)


def focal_by_vertical_edges(known: FocalLength, vertical: LensByVerticalEdges | None, width_px: int) -> FocalLength:
    """Returns the focal length from a fisheye's vertical edges, if the field of view is unknown."""
    if vertical is None or vertical.fisheye_focal is None or known.fisheye or known.sigma_rel < WIDE_SIGMA_REL:
        return known
    degrees = np.degrees(1.0 / vertical.fisheye_focal)
    by = f"that of a fisheye {degrees:.0f} deg across, from {vertical.edges} vertical edges"
    return FocalLength(vertical.fisheye_focal * width_px, WIDE_SIGMA_REL, by, by_view=False, fisheye=True)
