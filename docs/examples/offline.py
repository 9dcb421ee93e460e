"""A video file in, tracks, map and a picture out: python offline.py VIDEO CAMERA.toml DIRECTORY"""

import sys
from pathlib import Path

from birdslam import BirdSLAM, Recorder, load_camera, open_recording

video, camera_file, output = sys.argv[1:]
recording = open_recording(f"video:{video}", load_camera(Path(camera_file)))
slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
with Recorder(Path(output), recording.camera) as recorder:
    for frame in recording.undistorted_frames():
        measurements, estimate = slam.step(frame)
        recorder.add(estimate)
        if gained := slam.map_update():
            recorder.add_map(gained)
        pose = estimate.T_world_ego
        print(f"frame {frame.frame_id}: at {pose.x_m:.1f} {pose.y_m:.1f} m, {len(estimate.vehicles)} vehicles")
    recorder.finish({"video": video})
print(f"tracks, map.csv and bev.png are in {output}")
