"""Boxes of an external detector or tracker over a recording as a file, in px of the undistorted images.

MOT challenge text: `frame,id,left,top,width,height,score,...`, frames from 1, score -1: not stated; all are cars.
KITTI tracking text: `frame id type truncated occluded alpha x1 y1 x2 y2 ...`, frames from 0, score in column 18.
COCO results: JSON list of {"image_id", "category_id", "bbox": [left, top, width, height], "score", "track_id"}. Errors
are DatasetError with the first wrong line.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from birdslam.perception.decoding.detection import Detections, EdgeSigma
from birdslam.perception.external import external_detections
from birdslam.perception.families import Family
from birdslam.sources.recording import DatasetError, Recording

# COCO category ids of road users; other classes are ignored
COCO = {1: "person", 2: "bicycle", 3: "car", 4: "motorcycle", 6: "bus", 8: "truck"}
COCO_LAST = 90
COCO_GAPS = frozenset({12, 26, 29, 30, 45, 66, 68, 69, 71, 83})  # ids that the 2017 set does not use
COCO_80 = {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
# KITTI types of road users, and types that are ignored
KITTI = {"Car": "car", "Van": "van", "Truck": "truck", "Pedestrian": "person", "Person": "person", "Cyclist": "cyclist"}
KITTI_OTHERS = ("Person_sitting", "Tram", "Misc", "DontCare")
NOT_STATED = -1.0  # a score in MOT's text
_MAX_BYTES = 1 << 30
_MOT_COLUMNS, _KITTI_COLUMNS, _KITTI_SCORE = 7, 10, 17


class _Box(NamedTuple):
    frame: int
    track: int  # -1: none
    label: str
    box_px: tuple[float, float, float, float]  # x1, y1, x2, y2
    score: float


def read_detection_file(path: Path, detector: Family | EdgeSigma = "unknown") -> dict[int, Detections]:
    """Boxes by frame in the order of the file; frames without an entry are missing. Raises DatasetError.

    `detector` as in `external_detections`.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DatasetError(f"{path}: is larger than {_MAX_BYTES >> 30} GiB")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None
    frames: dict[int, list[tuple[str, _Box]]] = {}
    is_json = text.lstrip()[:1] in ("[", "{")
    for where, box in _coco(path, text) if is_json else _normalize_scores(path, list(_lines(path, text))):
        frames.setdefault(box.frame, []).append((where, box))
    if not frames:
        raise DatasetError(
            f"{path}: no boxes; expected MOT or KITTI tracking text or COCO results. For YOLO text, COCO data "
            "sets or supervision's CSV use `BirdSLAM.step(frame, detections)`"
        )
    return {frame: _of_frame(path, boxes, detector) for frame, boxes in frames.items()}


def check_detections(recording: Recording, path: Path, stride: int = 1) -> str:
    """Returns a summary of the boxes.

    Raises DatasetError if the file is not of this recording: boxes after its end, or all outside its images.
    """
    found = read_detection_file(path)
    if stride != 1:
        raise DatasetError(f"{path}: has boxes for each frame, but the stride is {stride}")
    last = max(found)
    if last >= len(recording):
        raise DatasetError(f"{path}: has boxes of frame {last}, {recording.name} ends at frame {len(recording) - 1}")
    width_px, height_px = recording.camera.width_px, recording.camera.height_px
    total = sum(len(boxes) for boxes in found.values())
    dropped = total - sum(len(boxes.inside(width_px, height_px)) for boxes in found.values())
    if dropped == total:
        raise DatasetError(f"{path}: all boxes are outside the image of {width_px}x{height_px} px")
    labels = Counter(label for boxes in found.values() for label in boxes.labels)
    words = f"{path}: {total} boxes, " + ", ".join(f"{count} of {label}" for label, count in labels.most_common(6))
    return words + (f"; {dropped} outside the image are dropped" if dropped else "")


def _of_frame(path: Path, boxes: list[tuple[str, _Box]], detector: Family | EdgeSigma) -> Detections:
    found = [box for _, box in boxes]
    ids = [box.track for box in found]
    try:
        return external_detections(
            [box.box_px for box in found],
            [box.label for box in found],
            [box.score for box in found],
            ids if max(ids) >= 0 else None,
            detector=detector,
        )
    except ValueError as error:
        raise DatasetError(f"{path}: {boxes[0][0]} to {boxes[-1][0]}: {error}") from None


def _lines(path: Path, text: str) -> Iterator[tuple[str, _Box]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            words = line.replace(",", " ").split()
            is_kitti = len(words) > 2 and words[2][:1].isalpha() and "," not in line
            yield f"line {number}", _kitti(words) if is_kitti else _mot(words)
        except ValueError as error:
            raise DatasetError(f"{path}: line {number}: {error or 'not a box'}: {line.strip()[:60]!r}") from None


def _normalize_scores(path: Path, found: list[tuple[str, _Box]]) -> Iterator[tuple[str, _Box]]:
    """Scores as probabilities: -1 becomes 1; if any other is not in [0, 1], all are log odds."""
    stated = [box.score for _, box in found if box.score != NOT_STATED]
    log_odds = any(not 0.0 <= score <= 1.0 for score in stated)
    for where, box in found:
        score = 1.0 if box.score == NOT_STATED else box.score
        yield where, box._replace(score=1.0 / (1.0 + math.exp(-max(score, -700.0))) if log_odds else score)


def _mot(words: list[str]) -> _Box:
    if len(words) < _MOT_COLUMNS:
        raise ValueError(f"has {len(words)} columns, MOT text has at least {_MOT_COLUMNS}")
    frame, track = (_to_whole(word) for word in words[:2])
    left, top, width, height, score = (float(word) for word in words[2:_MOT_COLUMNS])
    if frame < 1:
        raise ValueError("MOT frames start at 1")
    return _check(_Box(frame - 1, max(track, -1), "car", (left, top, left + width, top + height), score))


def _kitti(words: list[str]) -> _Box:
    if len(words) < _KITTI_COLUMNS:
        raise ValueError(f"has {len(words)} columns, KITTI text has at least {_KITTI_COLUMNS}")
    frame, track, kind = _to_whole(words[0]), _to_whole(words[1]), words[2]
    if kind not in KITTI and kind not in KITTI_OTHERS:
        raise ValueError(f"type {kind} is not one of {', '.join((*KITTI, *KITTI_OTHERS))}")
    x1, y1, x2, y2 = (float(word) for word in words[6:_KITTI_COLUMNS])
    score = float(words[_KITTI_SCORE]) if len(words) > _KITTI_SCORE else 1.0
    return _check(_Box(frame, max(track, -1), KITTI.get(kind, kind.lower()), (x1, y1, x2, y2), score))


def _coco(path: Path, text: str) -> Iterator[tuple[str, _Box]]:
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not JSON: {error}") from None
    if not isinstance(entries, list):
        raise DatasetError(f"{path}: COCO results are a list of boxes")
    labels = _coco_labels(path, entries)
    for number, entry in enumerate(entries):
        try:
            yield f"entry {number}", _coco_box(entry, labels)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DatasetError(f"{path}: entry {number} is not a box of COCO results: {error}") from None


def _coco_labels(path: Path, entries: list[Any]) -> dict[int, str]:
    """Class names by id: of the id set that contains all ids; if both do, of the one with more cars."""
    given = (entry.get("category_id") for entry in entries if isinstance(entry, dict))
    ids = Counter(number for number in given if isinstance(number, int | float))
    numbers = {number for number in ids if isinstance(number, int)}
    of_2017 = all(1 <= number <= COCO_LAST for number in numbers) and COCO_GAPS.isdisjoint(numbers)
    of_80 = all(0 <= number < 80 for number in numbers)
    if not of_2017 and not of_80:
        raise DatasetError(
            f"{path}: category_id: {sorted(numbers)[:5]} ... are neither in COCO's 1 to 90 nor in its 0 to 79"
        )
    return COCO if of_2017 and (not of_80 or ids[3] >= ids[2]) else COCO_80


def _coco_box(entry: dict[str, Any], labels: dict[int, str]) -> _Box:
    left, top, width, height = (float(number) for number in entry["bbox"])
    category = _to_whole(entry["category_id"])
    box_px = left, top, left + width, top + height
    track = _to_whole(entry.get("track_id", -1))
    label, score = labels.get(category, f"coco {category}"), float(entry.get("score", 1.0))
    if not 0.0 <= score <= 1.0:
        raise ValueError(f"score {score:g} is not in [0, 1]")
    return _check(_Box(_to_whole(entry["image_id"]), max(track, -1), label, box_px, score))


def _check(box: _Box) -> _Box:
    if box.frame < 0:
        raise ValueError(f"frame {box.frame} is invalid")
    if not all(map(math.isfinite, (*box.box_px, box.score))):
        raise ValueError("needs finite numbers")
    x1, y1, x2, y2 = box.box_px
    if x2 < x1 or y2 < y1:
        raise ValueError("width or height is negative")
    return box


def _to_whole(number: Any) -> int:
    """Raises ValueError unless the number is whole."""
    value = float(number)
    if not value.is_integer():
        raise ValueError(f"{number!r} is not a whole number")
    return int(value)
