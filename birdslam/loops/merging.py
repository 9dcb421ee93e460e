"""Merges two maps that share streets, and extracts parts of a map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops, held
from birdslam.loops.features import Features
from birdslam.loops.gnss.factors import georeference
from birdslam.loops.keyframe import Keyframe, Link
from birdslam.loops.localiser import is_place, shared
from birdslam.loops.place_map import PlaceMap
from birdslam.loops.verification import Fix, locate

CANDIDATES = 4
MIN_MEETINGS = 3  # keyframes that must agree on the transform between the maps
AGREE_M, AGREE_RAD = 3.0, math.radians(4.0)
POINT_SIGMA_PX = 1.0


class MergeError(ValueError):
    """The maps cannot be merged."""


def merged(first: PlaceMap, second: PlaceMap) -> tuple[PlaceMap, int]:
    """Returns the merged map in the frame of `first`, and the number of matched keyframes. Raises MergeError."""
    meetings = [(own, fix) for own in second.keyframes for fix in [_found(own, first)] if fix is not None]
    agreeing = _agreeing(meetings)
    if len(agreeing) < MIN_MEETINGS:
        raise MergeError(
            f"the maps have no recognised street in common: {len(agreeing)} of {len(second)} keyframes agree, "
            f"{MIN_MEETINGS} are needed"
        )
    number = {keyframe.number: first.next_number + row for row, keyframe in enumerate(second.keyframes)}
    own, fix = agreeing[len(agreeing) // 2]
    T_first_second = fix.T_map_ego @ own.T_map_keyframe.inverse()
    moved = [
        _renumbered(keyframe, number[keyframe.number], first.drives, T_first_second) for keyframe in second.keyframes
    ]
    links = [
        replace(link, from_number=number[link.from_number], to_number=number[link.to_number]) for link in second.links
    ]
    loops = [
        Link(fix.keyframe.number, number[own.number], fix.in_odometry, fix.cov + shared(fix), loop=True)
        for own, fix in agreeing
    ]
    keyframes, every = [*first.keyframes, *moved], [*first.links, *links, *loops]
    poses = close_loops(keyframes, every, agreed=True)
    out = PlaceMap(first.camera, keyframes, held(every, poses), None, first.drives + second.drives, first.earth)
    out.place(poses)
    out.learn()
    if out.earth is None and second.earth is not None:
        out.earth = second.earth.seen_from(T_first_second)
    if out.earth is not None:
        out.georeference(georeference(out.earth, out.keyframes, out.links, out.fixed()))
    return out, len(agreeing)


def part(place_map: PlaceMap, keeps: Callable[[Keyframe], bool]) -> PlaceMap:
    """Returns the map of the keyframes selected by `keeps`, with the links between them."""
    keyframes = [keyframe for keyframe in place_map.keyframes if keeps(keyframe)]
    numbers = {keyframe.number for keyframe in keyframes}
    links = [link for link in place_map.links if {link.from_number, link.to_number} <= numbers]
    out = PlaceMap(place_map.camera, keyframes, links, None, place_map.drives, place_map.earth)
    out.learn()
    return out


def _camera(keyframe: Keyframe, other: PlaceMap) -> Camera:
    """Returns a camera for the keyframe, to project its points without an image."""
    own = other.camera
    width_px, height_px = own.width_px, own.height_px
    return Camera(
        width_px=width_px,
        height_px=height_px,
        fx_px=own.fx_px,
        fy_px=own.fx_px,
        cx_px=width_px / 2.0,
        cy_px=height_px / 2.0,
        height_m=keyframe.camera_height_m,
    )


def _found(own: Keyframe, other: PlaceMap) -> Fix | None:
    camera = _camera(own, other)
    p = own.points_m - (0.0, 0.0, own.camera_height_m)
    px = camera.to_px(np.column_stack([-p[:, 1], -p[:, 2]]) / np.maximum(p[:, :1], 0.5))
    seen = Features(px, np.full(len(px), POINT_SIGMA_PX), own.descriptors)
    for row in other.index().look_up(own.descriptors, CANDIDATES):
        fix = locate(camera, seen, other.around(row), None)
        if fix is not None and is_place(fix):
            return fix
    return None


def _agreeing(meetings: list[tuple[Keyframe, Fix]]) -> list[tuple[Keyframe, Fix]]:
    """Returns the largest set of meetings that agree on the transform between the maps."""
    between = [fix.T_map_ego @ own.T_map_keyframe.inverse() for own, fix in meetings]
    best: list[int] = []
    for here, T in zip(meetings, between, strict=True):
        agreeing = []
        for row, (own, fix) in enumerate(meetings):
            foreseen = T @ own.T_map_keyframe
            error = foreseen.between(fix.T_map_ego)
            apart = here[0].T_map_keyframe.between(own.T_map_keyframe)
            slack_m = AGREE_M + 0.05 * math.hypot(apart.x_m, apart.y_m)  # both maps drift
            if math.hypot(error.x_m, error.y_m) < slack_m and abs(error.yaw_rad) < AGREE_RAD:
                agreeing.append(row)
        best = max(best, agreeing, key=len)
    return [meetings[row] for row in best]


def _renumbered(keyframe: Keyframe, number: int, drives: int, T_first_second: SE2) -> Keyframe:
    placed = keyframe.at(T_first_second @ keyframe.T_map_keyframe)
    lines = tuple(replace(piece, drive=piece.drive + drives) for piece in keyframe.lines)
    return replace(placed, number=number, drive=keyframe.drive + drives, lines=lines)
