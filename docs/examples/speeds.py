"""Distances and speeds of boxes: python speeds.py VIDEO CAMERA.toml BOXES OUT.mp4 (docs/planner.md)"""

import sys
from pathlib import Path

import supervision as sv

from birdslam import BirdSLAM, load_camera, open_recording
from birdslam.integrations.supervision import add_metres, from_supervision
from birdslam.perception.schedule import NO_DETECTIONS
from birdslam.sources.detection_file import read_detection_file

video, camera_file, boxes_file, output = sys.argv[1:]
camera, boxes = load_camera(Path(camera_file)), read_detection_file(Path(boxes_file))
recording = open_recording(f"video:{video}", camera)
slam = BirdSLAM.with_shipped_networks(camera, recording.rate_hz)
by_box = {"color_lookup": sv.ColorLookup.INDEX}
draw_box = sv.BoxAnnotator(**by_box, thickness=1)
draw_text = sv.LabelAnnotator(**by_box, text_scale=0.35, text_padding=2)
with sv.VideoSink(output, sv.VideoInfo(camera.width_px, camera.height_px, recording.rate_hz)) as sink:
    for frame in recording.undistorted_frames():
        found = boxes.get(frame.frame_id, NO_DETECTIONS)  # a detector in Python gives its sv.Detections here
        names = {"class_name": list(found.labels)}
        seen = sv.Detections(found.boxes_px, None, found.scores, tracker_id=found.track_ids, data=names)
        add_metres(seen, slam.step(frame, from_supervision(seen))[2])
        metres = zip(seen["distance_m"], seen["speed_mps"], strict=True)  # NaN: not placed
        texts = [f"{m:.0f} m {v:.0f} m/s" if m == m and v == v else "" for m, v in metres]
        sink.write_frame(draw_text.annotate(draw_box.annotate(frame.image.copy(), seen), seen, texts))
