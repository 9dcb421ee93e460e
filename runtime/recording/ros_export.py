"""Exports a recording as a ROS 2 bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from birdslam.loops.map_pose import MapPose
from birdslam.ros.bag_writer import BagWriter, Storage
from birdslam.ros.messages import RosMessages, t_of
from birdslam.runtime.configuration import SourceConfig
from birdslam.runtime.recording.recorded_drive import recorded_drive
from birdslam.runtime.recording.recording import Recording, RecordingError
from birdslam.runtime.schemes import is_live
from birdslam.types import EgoEdge, Estimate, MapUpdate


def write_bag(recording: Recording, directory: Path, storage: Storage) -> int:
    """Writes the bag into a new directory, stored as "mcap" or "sqlite3"; returns the number of frames.

    Raises BagError, and RecordingError for a recording without a camera or an estimate.
    """
    if recording.camera is None:
        raise RecordingError(f"{recording.path}: has no camera")
    live = is_live(recording.part("source", SourceConfig).uri)
    frames, t_ns = 0, 0
    with BagWriter(directory, storage) as bag:
        vehicle = str(recording.about.configuration.get("vehicle", ""))
        messages = RosMessages(bag.make, recording.camera, vehicle, keep_path=True)
        motion: EgoEdge | None = None
        map_poses = _MapPoses(recording)
        for record in recorded_drive([recording]):
            if isinstance(record, Estimate):
                t_ns = t_of(record, live)
                sent = [*([] if frames else [messages.fixed(t_ns)]), *messages.of_estimate(record, t_ns, motion)]
                for pose in map_poses.until(record.frame_id):
                    sent += messages.of_map_pose(pose, t_of(pose, live))
                frames, motion = frames + 1, None
            elif isinstance(record, MapUpdate):
                sent = list(messages.of_map(record, t_ns))
            else:
                sent, motion = [], record.cc
            for topic, message in sent:
                bag.write(topic, message, t_ns)
        if not frames:
            raise RecordingError(f"{recording.path}: has no estimate")
        for topic, message in messages.path():
            bag.write(topic, message, t_ns)
    return frames


class _MapPoses:
    """Iterates over a recording's poses in the map."""

    def __init__(self, recording: Recording) -> None:
        self._rest = (msgspec.json.decode(one.data, type=MapPose) for one in recording.messages(("/map_pose",)))
        self._next = next(self._rest, None)

    def until(self, frame_id: int) -> Iterator[MapPose]:
        """Yields the remaining poses up to a frame."""
        while self._next is not None and self._next.frame_id <= frame_id:
            yield self._next
            self._next = next(self._rest, None)
