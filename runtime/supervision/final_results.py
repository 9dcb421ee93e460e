"""Results written after a run: the final trajectories and the video.

Both come from the recording: the file of --record, else a temporary one in the output directory (.recording-*, left
behind if the supervisor is killed). A video shows the source's frames; those of a live camera are recorded as JPEG.
For the shipped drive the estimates are kept in memory, and its ground truth is drawn too.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from birdslam.geometry.arrays import Floats, Image
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.loops.gnss.earth import EarthError
from birdslam.loops.gnss.files import GnssError
from birdslam.outputs.drive_files import ResultsError, claim_directory
from birdslam.outputs.drive_video import CODEC, DriveVideo, check_video, frames_per_picture
from birdslam.outputs.final_trajectories import FinalTracks, last_seen, write_final_ego
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.maps.drive_earth import rows as earth_rows
from birdslam.runtime.maps.drive_map import DriveMap, check_map_choice
from birdslam.runtime.maps.gnss_input import fixes_of_file
from birdslam.runtime.maps.map_drive import rows as map_rows
from birdslam.runtime.nodes.sources import Source, open_source
from birdslam.runtime.progress import Progress
from birdslam.runtime.recording.recorded_drive import measurements_of, recorded_drive
from birdslam.runtime.recording.recorded_images import RecordedImages
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.supervision.demo_report import DemoReport
from birdslam.sources.recording import DatasetError
from birdslam.types import Estimate, MapUpdate, Measurements

DEMO_VIDEO = "drive.mp4"  # of the shipped drive, always written
TEMPORARY = "drive.mcap"
GNSS_UNUSED = "gnss_unused"  # of summary.json: why a track found inside a film does not place the drive on Earth

Frames = Iterator[tuple[int, int, Image | None]]  # frame_id, source time in ns, undistorted image
Records = Iterable[Measurements | Estimate | MapUpdate]


def check_results(configuration: Configuration, source: Source) -> None:
    """Raises ConfigurationError or ResultsError if a requested result can't be written."""
    results, recording = configuration.results, configuration.recording
    check_map_choice(configuration, source.camera)
    if not results.video:
        return
    output = Path(configuration.output)
    if Path(results.video).parent.resolve() == output.resolve():
        claim_directory(output)
    check_video(Path(results.video), source.camera, source.rate_hz)
    if configuration.live and recording.file and not recording.images:
        raise ConfigurationError(
            "results.video: the frames of a live camera are not kept; record them with --record-images"
        )


class FinalResults:
    """The final results of one run."""

    def __init__(self, configuration: Configuration, demo: DemoReport | None, film_track: Path | None = None) -> None:
        """`film_track`: GNSS fixes found inside a film, used where no map and no other fixes are requested."""
        self._config, self._demo = configuration, demo
        self._asked_video = bool(configuration.results.video)
        self._video: Path | None = None
        self.map = DriveMap.of(configuration)
        self._is_gnss_found = film_track is not None and self.map is None and not configuration.maps_live
        if film_track is not None and self._is_gnss_found:
            self.map = DriveMap(None, fixes_of_file(film_track, configuration.results.gnss_offset_s))
        if self._asked_video:
            self._video = Path(configuration.results.video)
        elif demo is not None:
            self._video = Path(configuration.output) / DEMO_VIDEO

    def recorded(self, stack: ExitStack) -> Configuration:
        """Returns the configuration, with a temporary recording if one is needed and none is configured."""
        config = self._config
        needed = config.results.smooth or (self._video is not None and self._demo is None)
        if not needed or config.recording.file:
            return config
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix=".recording-", dir=config.output))
        images = config.live and self._video is not None
        recording = msgspec.structs.replace(config.recording, file=str(Path(directory) / TEMPORARY), images=images)
        return msgspec.structs.replace(config, recording=recording)

    def write(self, files: Sequence[Path]) -> dict[str, Any]:
        """Writes the requested results from the recording in `files`; returns their entries of summary.json.

        Raises ResultsError, DatasetError, RecordingError or OSError; of a requested map or GNSS, its errors.
        """
        summary: dict[str, Any] = {}
        if self._config.results.smooth:
            summary["final_tracks"] = smooth(files, Path(self._config.output))
        if self._video is not None and (self._demo is None or self._demo.records):
            try:
                self._draw(self._video, files)
                summary["video"] = str(self._video)
            except ResultsError:
                if self._asked_video:
                    raise
                summary["video"] = None
        if self.map is not None and self._config.live:  # no frames to read again
            assert self._config.camera is not None
            summary |= self.map.finish(self._config.camera, iter(()), Path(self._config.output))
        elif self.map is not None:
            source = open_source(self._config)
            try:
                summary |= self.map.finish(source.camera, source_frames(source), Path(self._config.output))
            except (EarthError, GnssError) as error:
                if not self._is_gnss_found:
                    raise
                summary[GNSS_UNUSED] = str(error)
        return summary

    def _draw(self, path: Path, files: Sequence[Path]) -> None:
        truth = None if self._demo is None else self._demo.true_outlines
        records: Records = recorded_drive(map(Recording, files)) if self._demo is None else self._demo.records
        if self._config.live:
            camera, rate_hz, frames = recorded_frames(files)
        else:
            source = open_source(self._config)
            camera, rate_hz = source.camera, source.rate_hz
            frames = source_frames(source, frames_per_picture(rate_hz))
        draw_video(path, camera, rate_hz, frames, records, _last_frame(files, self._demo), truth)


def smooth(files: Sequence[Path], output: Path) -> int:
    """Writes the final trajectories beside the live ones in `output`; returns the number of vehicles.

    Reads the recording twice, so that only the vehicles in sight are in memory.
    """
    size = sum(path.stat().st_size for path in files)
    with Progress("smoothing", 2 * size, "MB", 1e6) as progress:
        tracks = FinalTracks(output / "tracks", last_seen(measurements_of(_recordings(files, progress, 0))))
        for record in recorded_drive(_recordings(files, progress, size)):
            tracks.take(record)
        tracks.finish()
    write_final_ego(output)
    return tracks.vehicles


def _recordings(files: Sequence[Path], progress: Progress, start: int) -> Iterator[Recording]:
    for path in files:
        yield Recording(path, lambda read, start=start: progress.reach(start + read))  # type: ignore[misc]
        start += path.stat().st_size


def draw_video(
    path: Path,
    camera: Camera,
    rate_hz: float,
    frames: Frames,
    records: Records,
    last_frame: int | None,
    truth: Callable[[int], Sequence[Floats]] | None = None,
) -> None:
    """Draws a whole drive. Raises ResultsError if the file can't be written."""
    with (
        Progress("video", last_frame) as progress,
        DriveVideo(path, camera, rate_hz, _read_ahead(frames), truth) as video,
    ):
        for record in records:
            if isinstance(record, Estimate):
                video.add(record)
                progress.reach(video.drawn_frame)
            elif isinstance(record, MapUpdate):
                video.add_map(record)
        video.finish()


def _read_ahead(frames: Frames) -> Frames:
    """Reads the next frame in a thread while the caller draws one."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, frames, None)
        while (frame := coming.result()) is not None:
            coming = thread.submit(next, frames, None)
            yield frame


def source_frames(source: Source, every: int = 1) -> Frames:
    """Yields the frames of a recording, numbered as in capture; only each `every`-th with its image."""
    undistort, camera = Undistorter(source.camera), source.camera
    for frame_id, recorded in enumerate(source.frames()):
        image = recorded.image if frame_id % every == 0 else None
        fits = image is not None and image.shape[1::-1] == (camera.width_px, camera.height_px)
        yield frame_id, recorded.t_source_ns, undistort(image) if image is not None and fits else None


def recorded_frames(files: Sequence[Path]) -> tuple[Camera, float, Frames]:
    """Returns the camera, its rate and the frames of a recording with images, numbered as in the run.

    Raises DatasetError if the first file has no images.
    """
    first = RecordedImages(files[0])

    def frames() -> Frames:
        for path in files:
            try:
                images = RecordedImages(path)
            except DatasetError:  # a restarted recorder that wrote less than two frames
                continue
            for frame in images.frames():
                yield images.first_frame + frame.index, frame.t_source_ns, frame.image

    return first.camera, first.rate_hz, frames()


def _last_frame(files: Sequence[Path], demo: DemoReport | None) -> int | None:
    """Returns the frame of the last estimate, for the progress."""
    if demo is not None:
        return max((r.frame_id for r in demo.records if isinstance(r, Estimate)), default=None)
    return max((m.frame_id for m in measurements_of(map(Recording, files))), default=None)


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the rows of the summary table about the final results."""
    out = []
    if "final_tracks" in summary:
        out.append(
            ("final trajectories", f"of {summary['final_tracks']} vehicles: tracks/ID.final.tum.txt, ego.final.*")
        )
    if "video" in summary:
        out.append(("video", summary["video"] or f"none: this OpenCV can't write {CODEC}"))
    if "map" in summary:
        out += map_rows(summary["map"])
    if "earth" in summary:
        out += earth_rows(summary["earth"])
    return out
