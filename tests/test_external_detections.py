"""Boxes of an external detector: from a program, a file, or objects of other libraries, with external track ids."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam import BirdSLAM, Camera, Frame, open_recording
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.integrations import norfair as norfair_adapter
from birdslam.integrations import supervision as supervision_adapter
from birdslam.perception import Detections
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.perception.external import external_detections, undistort_boxes
from birdslam.perception.families import FAMILIES, UNKNOWN
from birdslam.road_users.placed_boxes import PlacedBox
from birdslam.road_users.placement.localisation import LocalisationConfig
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig
from birdslam.road_users.tracking import Tracker
from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.configuration import Configuration, ConfigurationError, load
from birdslam.runtime.nodes.inference import source_detections
from birdslam.runtime.nodes.sources import open_source
from birdslam.sources.detection_file import check_detections, read_detection_file
from birdslam.sources.recording import DatasetError
from birdslam.types import Estimate

FRAMES = 7
NAMES = ("person", "bicycle", "car", "motorcycle", "bus", "truck", "van", "trailer", "cyclist")
LENS = Camera(1280, 720, 900.0, 900.0, 640.0, 360.0, 1.4, distortion=(-0.3, 0.1, 0.001, -0.002))


@dataclass
class Seen:
    """Frames of the shipped drive, the network's detections in them, and the results of `step` for those boxes."""

    recording: Any
    frames: list[Frame]
    found: list[Detections]
    placed: list[tuple[PlacedBox | None, ...]]
    estimates: list[Estimate]


@pytest.fixture(scope="module")
def seen() -> Seen:
    recording = open_recording("demo")
    looking = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz).networks
    slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
    out = Seen(recording, [], [], [], [])
    for frame in recording.undistorted_frames():
        boxes = looking.start(frame.frame_id, frame.image).result().detections
        given_boxes = external_detections(boxes.boxes_px, list(boxes.labels), boxes.scores)
        _, estimate, placed = slam.step(frame, given_boxes)
        out.frames.append(frame)
        out.found.append(given_boxes)
        out.placed.append(placed)
        out.estimates.append(estimate)
        if len(out.frames) == FRAMES:
            return out
    raise AssertionError("the shipped drive is longer")


def test_each_box_has_a_result_at_its_index(seen: Seen) -> None:
    for found, placed, estimate in zip(seen.found, seen.placed, seen.estimates, strict=True):
        assert len(placed) == len(found)
        reported = {vehicle.vehicle: vehicle for vehicle in estimate.vehicles}
        for place in placed:
            if place is not None and place.track in reported:
                T_ego_vehicle = estimate.T_world_ego.between(reported[place.track].T_world_vehicle)
                assert (place.x_m, place.y_m) == (T_ego_vehicle.x_m, T_ego_vehicle.y_m)
                speed_mps = float(np.hypot(*reported[place.track].velocity_mps))
                assert place.speed_mps == pytest.approx(speed_mps, abs=1e-9)
    last = [place for place in seen.placed[-1] if place is not None and place.track is not None]
    assert len(last) >= 3
    assert all(place.distance_sigma_m > 0.0 and place.speed_sigma_mps is not None for place in last)


def test_order_of_boxes_is_kept(seen: Seen) -> None:
    slam = BirdSLAM.with_shipped_networks(seen.recording.camera, seen.recording.rate_hz)
    for frame, found, placed in zip(seen.frames, seen.found, seen.placed, strict=True):
        back = slice(None, None, -1)
        turned = external_detections(found.boxes_px[back], found.labels[back], found.scores[back])
        assert slam.step(frame, turned)[2] == placed[back]


def test_a_file_of_the_same_boxes_gives_the_same_estimates(seen: Seen, tmp_path: Path) -> None:
    lines = [
        {"image_id": frame.frame_id, "category_id": 3, "bbox": [x1, y1, x2 - x1, y2 - y1], "score": score}
        for frame, found in zip(seen.frames, seen.found, strict=True)
        for (x1, y1, x2, y2), score in zip(found.boxes_px.tolist(), found.scores.tolist(), strict=True)
    ]
    file = tmp_path / "boxes.json"
    file.write_text(json.dumps(lines))
    slam = BirdSLAM.with_shipped_networks(seen.recording.camera, seen.recording.rate_hz)
    boxes = read_detection_file(file)
    expected = [slam.step(frame, boxes[frame.frame_id])[1].vehicles for frame in seen.frames]
    configuration = load(None, {"source.uri": "demo", "source.detections": str(file), "source.frames": FRAMES})
    with pipeline(configuration) as drive:
        driven = [record for record in drive(seen.recording) if isinstance(record, Estimate)][:FRAMES]
    assert [estimate.vehicles for estimate in driven] == expected
    assert any(expected)


def test_ids_of_external_tracker_are_kept() -> None:
    camera, ground = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65), GroundPlane(1.65)
    tracker = Tracker(camera, TrackingConfig(), LocalisationConfig(), GroundSizeFilter(camera, GroundSizeConfig()))
    rows = camera.cy_px + camera.fy_px * ground.height_m / np.array([12.0, 12.0, 20.0])
    for frame in range(4):
        tracker.ground_size.predict(0.1, None, None, None, 0.0)
        left = np.array([300.0, 420.0, 700.0])
        heights = np.array([90.0, 90.0, 54.0])
        boxes = np.column_stack([left, rows - heights, left + 100.0, rows])
        # The two at one depth swap their places: what our own association would call a swap of ids, the other's decides
        ids = np.array([70, 7, -1]) if frame % 2 == 0 else np.array([7, 70, -1])
        detections = external_detections(boxes, ["car"] * 3, track_ids=ids)
        tracks = tracker.localise_vehicles(EgoFrame(frame, frame * 100_000_000, SE2()), detections)
        if frame:
            assert {track.number: track.observation.row for track in tracks} == {int(ids[0]): 0, int(ids[1]): 1}


def test_only_filters_ids_along_with_boxes() -> None:
    both = external_detections([[0, 0, 9, 9], [5, 5, 9, 9]], ["cat", "car"], [0.5, 0.6], [3, 4])
    ids = both.only({"car"}).track_ids
    assert ids.tolist() == [4]


@pytest.mark.parametrize(
    ("boxes", "labels", "scores", "ids", "says"),
    [
        ([[0, 0, 9, 9]], [], None, None, "labels: 0 for 1"),
        ([[0, 0, 9, 9]], ["car"], [1.0, 0.5], None, "scores: 2 for 1"),
        ([[0, 0, np.nan, 9]], ["car"], None, None, "finite"),
        ([[9, 0, 0, 9]], ["car"], None, None, "x1 <= x2"),
        ([[0, 0, 9, 9]], ["car"], [1.5], None, r"in \[0, 1\]"),
        ([[0, 0, 9, 9]] * 2, ["car"] * 2, None, [4, 4], "unique"),
        ([[0, 0, 9, 9]], ["car"], None, [0.5], "integers"),
    ],
)
def test_invalid_boxes_are_refused(boxes: Any, labels: Any, scores: Any, ids: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        external_detections(boxes, labels, scores, ids)


@given(st.floats(100, 900), st.floats(100, 500), st.floats(20, 250), st.floats(20, 150))
def test_box_of_distorted_image_is_undistorted(x: float, y: float, width: float, height: float) -> None:
    box = np.array([[x, y, x + width, y + height]])
    straight = undistort_boxes(LENS, box)[0]
    x1, y1, x2, y2 = straight
    sides = np.array([(x1, (y + y + height) / 2), ((x + x + width) / 2, y1)])
    assert x1 < x2
    assert y1 < y2
    # Back by the model that OpenCV's maps use: the left side's middle is where it was
    points = undistort_points_back(np.array([[x, y + height / 2]]))
    assert points[0, 0] == pytest.approx(sides[0, 0], abs=0.05)


def undistort_points_back(px: np.ndarray) -> np.ndarray:
    K = LENS.K
    return cv2.undistortPoints(px.reshape(-1, 1, 2), K, np.array(LENS.distortion), P=K).reshape(-1, 2)


def test_edge_sigma_follows_the_detector_family(tmp_path: Path) -> None:
    boxes, labels = [[10.0, 20.0, 40.0, 60.0]], ["car"]
    assert external_detections(boxes, labels).edge_sigma == UNKNOWN
    assert external_detections(boxes, labels, detector="configured").edge_sigma is None
    for family, sigma in FAMILIES.items():
        assert external_detections(boxes, labels, detector=family).edge_sigma == sigma
        assert all(of <= widest for of, widest in zip(sigma.rel, UNKNOWN.rel, strict=True))
    own = EdgeSigma((0.01, 0.02, 0.03, 0.04), 0.5)
    theirs = [Corners(np.array([[10.0, 20.0], [40.0, 60.0]]))]
    assert norfair_adapter.from_norfair(theirs, detector=own).edge_sigma == own
    with pytest.raises(ValueError, match="unknown detector family 'yolo'; expected one of rrc, yolox"):
        external_detections(boxes, labels, detector="yolo")
    file = tmp_path / "boxes.txt"
    file.write_text("1,-1,10,20,30,40,0.9\n")
    configuration = load(None, {"source.detections": str(file), "source.detector": "yolox"})
    read = source_detections(configuration)
    assert read[0].edge_sigma == FAMILIES["yolox"]
    with pytest.raises(ConfigurationError, match=r"source\.detector"):
        load(None, {"source.detector": "yolo"})


def test_all_three_kinds_of_file_are_read(tmp_path: Path) -> None:
    mot, kitti, coco = tmp_path / "mot.txt", tmp_path / "kitti.txt", tmp_path / "coco.json"
    mot.write_text("1,5,10,20,30,40,0.9,-1,-1,-1\n2,5,12,20,30,40,0.8,-1,-1,-1\n")
    kitti.write_text("0 5 Car 0 0 -10 10 20 40 60 -1 -1 -1 -1000 -1000 -1000 -10 0.9\n1 5 Car 0 0 -10 12 20 42 60\n")
    coco.write_text(
        '[{"image_id": 0, "category_id": 3, "bbox": [10, 20, 30, 40], "score": 0.9, "track_id": 5},'
        ' {"image_id": 1, "category_id": 3, "bbox": [12, 20, 30, 40], "score": 0.8, "track_id": 5}]'
    )
    for path in (mot, kitti, coco):
        found = read_detection_file(path)
        assert found[0].boxes_px.tolist() == [[10.0, 20.0, 40.0, 60.0]]
        assert found[1].boxes_px.tolist() == [[12.0, 20.0, 42.0, 60.0]]
        assert [(f.labels, None if f.track_ids is None else f.track_ids.tolist()) for f in found.values()] == [
            (("car",), [5])
        ] * 2
        assert found[0].scores.tolist() == [0.9]


@pytest.mark.parametrize("separator", [",", " ", ", "])
@pytest.mark.parametrize(
    ("scores", "means"), [((-1, -1), (1.0, 1.0)), ((0.9, 0.2), (0.9, 0.2)), ((2.3, 0.0), (0.909, 0.5))]
)
def test_scores_of_mot_text_are_probabilities(
    tmp_path: Path, separator: str, scores: tuple[float, float], means: tuple[float, float]
) -> None:
    """-1 is not stated (MOT's example, norfair); scores beyond 1 are log odds (DPM)."""
    path = tmp_path / "mot.txt"
    lines = [separator.join(map(str, (k + 1, -1, 10, 20, 30, 40, score, -1, -1, -1))) for k, score in enumerate(scores)]
    path.write_text("\n".join(lines))
    found = read_detection_file(path)
    assert [found[k].scores[0] for k in (0, 1)] == pytest.approx(means, abs=1e-3)
    assert found[0].boxes_px.tolist() == [[10.0, 20.0, 40.0, 60.0]]


@pytest.mark.parametrize(
    ("ids", "labels"),
    [
        ((3, 1, 8), ("car", "person", "truck")),  # the 2017 set
        ((2, 0, 7), ("car", "person", "truck")),  # the 80 classes; the 2017 set has no class 0
        ((2, 2, 5), ("car", "car", "bus")),  # both sets know these ids: cars are more frequent than bicycles
        ((3, 3, 2), ("car", "car", "bicycle")),
        ((2, 12, 7), ("car", "coco 12", "truck")),  # 12 is a gap of the 2017 set
    ],
)
def test_the_id_set_of_coco_is_recognized(tmp_path: Path, ids: tuple[int, ...], labels: tuple[str, ...]) -> None:
    path = tmp_path / "coco.json"
    path.write_text(json.dumps([{"image_id": k, "category_id": c, "bbox": [1, 2, 3, 4]} for k, c in enumerate(ids)]))
    assert tuple(boxes.labels[0] for boxes in read_detection_file(path).values()) == labels


@given(st.lists(st.tuples(*[st.floats(-2000.0, 2000.0)] * 2, *[st.floats(1.0, 500.0)] * 2), min_size=1))
def test_boxes_inside_lie_in_the_image(corners: list[tuple[float, float, float, float]]) -> None:
    box = np.array([(x, y, x + w, y + h) for x, y, w, h in corners])
    found = Detections(box, np.full(len(box), 0.5), ("car",) * len(box)).inside(640, 480)
    assert (found.boxes_px >= 0.0).all()
    assert (found.boxes_px <= [640, 480, 640, 480]).all()
    assert len(found) == sum(x < 640 and y < 480 and x + w > 0 and y + h > 0 for x, y, w, h in corners)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1,5,10,20,30,40,0.9\n1,5,10,20,thirty,40,0.9\n", "line 2"),
        ("1,5,10,20,30,40,0.9\n2,5,10,20\n", "line 2: has 4 columns"),
        ("0,5,10,20,30,40,0.9\n", "frames start at 1"),
        ("1,5,10,20,-30,40,0.9\n", "line 1: width"),
        ("1,5,10,20,nan,40,0.9\n", "line 1: needs finite"),
        ("1.5,5,10,20,30,40,0.9\n", "line 1: '1.5' is not a whole number"),
        ("1,5,10,20,30,40,0.9\n1,5,50,20,30,40,0.9\n", "line 1 to line 2: track_ids"),
        ("0 5 Car 0 0 -10 10 20 40\n", "line 1: has 9 columns"),
        ("0 5 Car 0 0 0 1 2 3 4\n0 6 car 0 0 0 5 2 9 4\n", "line 2: type car is not one of Car, Van"),
        ('[{"image_id": 0, "category_id": 95, "bbox": [1, 2, 3, 4], "score": 1}]', "neither in COCO's 1 to 90"),
        ("", "no boxes"),
        ("[{]", "not JSON"),
        ('{"images": []}', "are a list"),
        ('[{"image_id": 0, "category_id": 3}]', "entry 0 is not a box"),
        ('[{"image_id": 0, "category_id": 3, "bbox": [1, 2, 3], "score": 1}]', "entry 0 is not a box"),
    ],
)
def test_invalid_file_names_its_first_wrong_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "boxes"
    path.write_text(text)
    with pytest.raises(DatasetError, match=says):
        read_detection_file(path)


def test_a_file_of_another_drive_is_refused(tmp_path: Path, seen: Seen) -> None:
    path = tmp_path / "boxes.txt"
    path.write_text(f"{len(seen.recording)},-1,10,20,30,40,0.9\n")
    check_detections(seen.recording, path)
    with pytest.raises(DatasetError, match="the stride is 2"):
        check_detections(seen.recording, path, stride=2)
    path.write_text(f"{len(seen.recording) + 1},-1,10,20,30,40,0.9\n")
    with pytest.raises(DatasetError, match="ends at"):
        check_detections(seen.recording, path)
    path.write_text("1,-1,9000,20,30,40,0.9\n")
    with pytest.raises(DatasetError, match="outside the image"):
        check_detections(seen.recording, path)
    path.write_text("1,-1,9000,20,30,40,0.9\n1,-1,-10,20,30,40,0.9\n")
    assert check_detections(seen.recording, path).endswith("2 boxes, 2 of car; 1 outside the image are dropped")
    with pytest.raises(ConfigurationError, match=r"remove source\.loop"):
        open_source(load(None, {"source.uri": "demo", "source.loop": True, "source.detections": str(path)}))
    assert Configuration().source.detections == ""


def test_supervision_boxes_get_metres_in_columns(seen: Seen) -> None:
    supervision = pytest.importorskip("supervision")
    slam = BirdSLAM.with_shipped_networks(seen.recording.camera, seen.recording.rate_hz)
    for frame, found, placed in zip(seen.frames, seen.found, seen.placed, strict=True):
        class_id = np.array([NAMES.index(label) for label in found.labels])
        theirs = supervision.Detections(found.boxes_px, confidence=found.scores, class_id=class_id)
        ours = supervision_adapter.from_supervision(theirs, names=dict(enumerate(NAMES)))
        answered = slam.step(frame, ours)[2]
        assert answered == placed
        supervision_adapter.add_metres(theirs, answered)
    near = theirs[theirs.data["distance_m"] < 30.0]  # columns are filtered along with the boxes
    assert 0 < len(near) < len(theirs)
    for distance_m, track in zip(near.data["distance_m"], near.data["track"], strict=True):
        assert any(p is not None and p.track == track and p.distance_m == distance_m for p in placed)
    with pytest.raises(ValueError, match="no class_name"):
        supervision_adapter.from_supervision(theirs)
    with pytest.raises(ValueError, match="1 positions for"):
        supervision_adapter.add_metres(theirs, [None])


@dataclass
class Corners:
    """As `norfair.Detection`: the package itself wants numpy below 2."""

    points: np.ndarray
    label: str = "car"
    scores: np.ndarray | None = None
    data: Any = None


@dataclass
class Tracked:
    """As `norfair.TrackedObject`."""

    id: int | None
    last_detection: Corners
    label: str = field(default="car")


def test_norfair_objects_keep_ids_and_get_positions(seen: Seen) -> None:
    slam = BirdSLAM.with_shipped_networks(seen.recording.camera, seen.recording.rate_hz)
    for frame, found in zip(seen.frames, seen.found, strict=True):
        x = np.argsort(found.boxes_px[:, 0])[:3]  # three whose order across the image lasts
        corners = [Corners(found.boxes_px[i].reshape(2, 2), scores=np.array([0.9, 0.9])) for i in x]
        tracked = [Tracked(100 + k, corner) for k, corner in enumerate(corners)]
        ours = norfair_adapter.from_norfair(tracked)
        assert ours.track_ids.tolist() == [100, 101, 102]
        norfair_adapter.add_metres(tracked, slam.step(frame, ours)[2])
    tracks = {each.last_detection.data["birdslam"].track for each in tracked if each.last_detection.data["birdslam"]}
    assert tracks <= {None, 100, 101, 102}
    assert tracks - {None}
    assert norfair_adapter.from_norfair([Corners(np.zeros((2, 2)))]).track_ids is None
    with pytest.raises(ValueError, match="two corners"):
        norfair_adapter.from_norfair([Corners(np.zeros((1, 2)))])
    with pytest.raises(ValueError, match="data is a list"):
        norfair_adapter.add_metres([Corners(np.zeros((2, 2)), data=[1])], [None])
