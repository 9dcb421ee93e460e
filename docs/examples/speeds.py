"""Distances and speeds of another detector's boxes: python speeds.py VIDEO CAMERA.toml BOXES OUT.mp4 (pip install
'birdslam[supervision]'). BOXES is a file of MOT, KITTI or COCO (docs/networks.md); a detector in Python hands over its
`supervision.Detections` in its place."""

import sys
from pathlib import Path

import supervision as sv

from birdslam import BirdSLAM, load_camera, open_recording
from birdslam.integrations.supervision import add_metres, from_supervision
from birdslam.sources.detection_file import read_detection_file

video, camera_file, boxes_file, output = sys.argv[1:]
recording = open_recording(f"video:{video}", load_camera(Path(camera_file)))
slam, boxes = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz), read_detection_file(Path(boxes_file))
draw_box, draw_label = (kind(color_lookup=sv.ColorLookup.INDEX) for kind in (sv.BoxAnnotator, sv.LabelAnnotator))
size = sv.VideoInfo(recording.camera.width_px, recording.camera.height_px, recording.rate_hz)
with sv.VideoSink(output, size) as sink:
    for frame in recording.undistorted_frames():
        found = boxes.get(frame.frame_id)
        detections = sv.Detections.empty() if found is None else sv.Detections(found.boxes_px, confidence=found.scores)
        detections.data["class_name"] = [] if found is None else list(found.labels)
        measurements, estimate, placed = slam.step(frame, from_supervision(detections))
        add_metres(detections, placed)
        labels = [
            f"{m:.0f} m {v:.0f} m/s" for m, v in zip(detections["distance_m"], detections["speed_mps"], strict=True)
        ]
        sink.write_frame(draw_label.annotate(draw_box.annotate(frame.image.copy(), detections), detections, labels))
