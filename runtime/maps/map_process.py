"""The map process: it subscribes, localises the drive in a map and makes that longer; no node waits for it.

`python -m birdslam.runtime.maps.map_process map VITALS_FD PARENT_PID`, on standard input the configuration as a line of
JSON, then an `Assignment` as another. It ends when the end of the source has come through, or on SIGTERM. Exit status:
0 when all is written; 2 where the map can't be used, 3 where the disk failed it in the end, each with one ERROR line;
1 for a bug. One that died or stalled is restarted with the map as it was last saved, and goes on where it had come to
if odometry does. Its map is saved whole every ten seconds or so; a disk that is full costs what was not saved yet.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
from numpy.typing import NDArray

from birdslam.geometry.camera import Undistorter
from birdslam.loops.gnss.earth import EarthError, GnssFix
from birdslam.loops.gnss.files import GnssError
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_file import MapError
from birdslam.loops.map_pose import MapPose
from birdslam.outputs.placed import Place, write_places
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.maps.drive_earth import write_earth
from birdslam.runtime.maps.gnss_input import Fixes, Receiver, is_serial, recorded_fixes
from birdslam.runtime.maps.map_drive import MapChoice, MapDrive
from birdslam.runtime.process import realtime
from birdslam.runtime.process.beside import DISK_STATUS, Stop, run_beside
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.topology import MAP
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.transport.presence import ring_path, runtime_dir_of
from birdslam.runtime.transport.ring import FrameError, FrameReader
from birdslam.runtime.wire import Health, WireError, decode, encode
from birdslam.types import Estimate, FrameRef, Status

TURN_S = 0.05  # what has come is taken up at least so often
END_S = 2.0  # after SIGTERM, for the end of the source to come through
HEALTH_NS = 1_000_000_000
WAITING_ESTIMATES = 1024  # while a loop is closed
HELD_MIB = 8.0, 46.0  # of small objects and of others: WAITING_ESTIMATES as bytes, 10 kB each, and what a look needs
WAITING_IMAGES = 4  # of frames whose estimates have not come yet: the oldest, however late estimates are
# Of one core, that looking at images may take in the long run; odometry carries the frames between. What it takes the
# frames feel, whatever its priority: caches and memory are shared
CPU_SHARE = 0.25
SAVE_EVERY_S, SAVE_SHARE = 10.0, 0.02  # and a large map so seldom that writing it takes no more of the time
NICENESS = 10  # all others go first
SUMMARY = "map.json"  # beside the logs: what the supervisor puts into summary.json

log = logging.getLogger(__name__)


class LiveMap:
    """From the bus into the map, and `map_pose` back."""

    def __init__(self, configuration: Configuration, bus: Bus, vitals: Vitals, assignment: Assignment) -> None:
        """Raises MapError, ConfigurationError, OSError."""
        choice, camera = MapChoice.of(configuration), configuration.camera
        assert choice is not None
        assert camera is not None
        self._config, self._vitals, self._assignment = configuration, vitals, assignment
        self._frames = bus.subscriber("frame", WAITING_IMAGES)
        self._estimates = bus.subscriber("estimate", WAITING_ESTIMATES)
        self._poses, self._health = bus.publisher("map_pose"), bus.publisher("health/map")
        self._ring = FrameReader(ring_path(configuration.vehicle, configuration.runtime_dir))
        self._undistort = Undistorter(camera)
        self._images: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._output = Path(configuration.output)
        self._drive = MapDrive(choice, camera, self._output)
        self._last_pose = runtime_dir_of(configuration.vehicle, configuration.runtime_dir) / "map_pose"
        if assignment.restarts:
            self._go_on()
        else:
            self._last_pose.unlink(missing_ok=True)
        gnss = configuration.results.gnss
        self._fixes: list[GnssFix] = []
        self._receiver = Receiver(gnss) if gnss and is_serial(gnss) else None
        self._recorded = recorded_fixes(configuration)
        self._clock_ns = 0  # of the source, from CLOCK_MONOTONIC
        self._newest: MapPose | None = None
        self._saved_epoch = 0  # of the map in the file
        self._next_look_ns = 0  # CLOCK_MONOTONIC, by the budget
        self._saved_s, self._save_took_s = time.monotonic(), 0.0
        self._process = psutil.Process()
        self._process.cpu_percent()
        self._reported_ns, self._stepped, self._stepped_reported = time.monotonic_ns(), 0, 0
        self.looks = self.torn = 0
        self.ended = False

    def _go_on(self) -> None:
        """Where the process before this one had come to; it holds where odometry's epoch is still the same."""
        try:
            self._drive.resume(decode(self._last_pose.read_bytes(), MapPose))
        except (OSError, WireError) as error:
            log.warning("where the map process had come to is not known: %s", error)

    def turn(self, timeout_s: float) -> bool:
        """Takes up one estimate, and the images that have come; whether there was one.

        One, so that a process that can't keep up reports, saves and beats like any other.
        """
        message = self._estimates.recv(timeout_s)
        self._take_images()
        if message is not None and not self.ended:
            estimate: Estimate = message.record
            if Status.END_OF_SOURCE in estimate.status:
                self.ended = True
            else:
                self._step(estimate)
        now_ns = time.monotonic_ns()
        if now_ns - self._reported_ns >= HEALTH_NS:
            self._report(now_ns)
        if self._save_due():
            self._save()
        self._vitals.count(frames=self._stepped, torn=self.torn, looks=self.looks)
        self._vitals.beat()
        return message is not None

    def _take_images(self) -> None:
        """Pixels stay in the ring for a few frames only; of those that will not be looked at none is copied."""
        while (message := self._frames.recv(0.0)) is not None:
            ref: FrameRef = message.record
            if ref.slot < 0 or ref.t_capture_ns < self._next_look_ns or len(self._images) == WAITING_IMAGES:
                continue
            try:
                image = self._ring.read(ref)
                if image is not None:
                    self._images[ref.frame_id] = image
            except FrameError as error:
                log.warning("frame %d is not looked at: %s", ref.frame_id, error)
                image = None
            self.torn += image is None

    def _step(self, estimate: Estimate) -> None:
        image = None
        while self._images and next(iter(self._images)) <= estimate.frame_id:
            frame_id, pixels = self._images.popitem(last=False)
            image = pixels if frame_id == estimate.frame_id else None
        begun_s = time.process_time()
        looked = image is not None and self._drive.due(estimate)
        found = self._drive.step(estimate, self._undistort(image) if image is not None and looked else None)
        if looked:
            took_ns = (time.process_time() - begun_s) * 1e9
            self._next_look_ns = estimate.t_capture_ns + round(took_ns / CPU_SHARE)
            self.looks += 1
        self._stepped += 1
        self._newest = self._pose(estimate, found)
        self._poses.put(self._newest)
        self._clock_ns = estimate.t_source_ns - estimate.t_capture_ns
        if self._receiver is not None:
            self._fixes += self._receiver.take(self._clock_ns)
        self._take_images()

    def _pose(self, estimate: Estimate, found: Localisation) -> MapPose:
        lost = found.T_map_ego is None
        return MapPose(
            frame_id=estimate.frame_id,
            t_source_ns=estimate.t_source_ns,
            t_capture_ns=estimate.t_capture_ns,
            t_utc_ns=estimate.t_utc_ns,
            epoch=estimate.epoch,
            state=found.state,
            map_epoch=found.map_epoch,
            T_map_odom=self._drive.T_map_odom,
            T_odom_ego=None if lost else estimate.T_world_ego,
            cov=None if lost else tuple(float(number) for number in found.cov.ravel()),
            inliers=found.inliers,
            keyframes=len(self._drive.map),
            earth=self._drive.on_earth(found),
        )

    def _report(self, now_ns: int) -> None:
        rate_hz = (self._stepped - self._stepped_reported) * 1e9 / (now_ns - self._reported_ns)
        self._reported_ns, self._stepped_reported = now_ns, self._stepped
        health = Health(
            node=MAP.name,
            t_ns=now_ns,
            frames=self._stepped,
            dropped=self._estimates.dropped,
            malformed=self._estimates.malformed + self._frames.malformed,
            torn=self.torn,
            rate_hz=rate_hz,
            rss_bytes=self._process.memory_info().rss,
            cpu_percent=self._process.cpu_percent(),
            restarts=self._assignment.restarts,
            cause=self._assignment.cause[:200],
            looks=self.looks,
        )
        self._health.put(health)
        if self._newest is not None and self._newest.map_epoch == self._saved_epoch:
            self._keep(self._newest)

    def _keep(self, pose: MapPose) -> None:
        """For the process after this one: where the drive is in the map as its file has it."""
        draft = self._last_pose.with_suffix(".draft")
        try:
            draft.write_bytes(encode(pose))
            draft.replace(self._last_pose)
        except OSError as error:
            log.warning("where the map process is can't be kept: %s", error)

    def _save_due(self) -> bool:
        old = self._drive.unsaved or (self._newest is not None and self._newest.map_epoch != self._saved_epoch)
        return old and time.monotonic() - self._saved_s > max(SAVE_EVERY_S, self._save_took_s / SAVE_SHARE)

    def _save(self) -> None:
        begun_s = time.monotonic()
        try:
            self._drive.save()
            if self._newest is not None:
                self._saved_epoch = self._newest.map_epoch
                self._keep(self._newest)
        except MapError as error:
            log.warning("%s", error)
        self._saved_s = time.monotonic()
        self._save_took_s = self._saved_s - begun_s

    def finish(self) -> str:
        """Ends the drive, and writes the map; why it could not be written, or nothing."""
        summary: dict[str, Any] = {}
        reason = ""
        try:
            self._drive.end()
        except OSError as failure:
            reason = f"{self._output}: can't be written: {failure.strerror}"
        try:
            summary["map"] = self._drive.summary() | {"looks": self.looks, "torn": self.torn}
            places = self._come_to_earth(summary)
            self._drive.write(summary["map"])
            write_places(self._output, places)
        except (MapError, OSError) as failure:
            reason = str(failure)
        if reason:
            summary["map"]["error"] = reason
        try:
            (self._output / "logs" / SUMMARY).write_bytes(msgspec.json.encode(summary))
        except OSError as failure:
            reason = reason or f"{self._output}: can't be written: {failure.strerror}"
        return reason

    def _come_to_earth(self, summary: dict[str, Any]) -> list[Place]:
        """The drive's places. What is wrong with the fixes costs the map nothing."""
        fixes: Fixes | list[GnssFix] | None = self._recorded
        if self._receiver is not None:
            fixes = [*self._fixes, *self._receiver.take(self._clock_ns)]
            self._receiver.close()
        if fixes is None:
            return self._drive.places
        assert self._config.camera is not None
        try:
            places = self._drive.places
            summary["earth"], places = write_earth(fixes, places, self._config.camera, self._output, self._drive.map)
            return places
        except (GnssError, EarthError) as error:
            log.warning("the drive is not on Earth: %s", error)
            return self._drive.places


def localise(configuration: Configuration, assignment: Assignment, vitals: Vitals, stop: Stop) -> int:
    """The whole work of the process; its exit status."""
    import faiss  # noqa: F401  # now, and not with the first look-up in the middle of the drive

    with Bus(configuration.vehicle, MAP.name, runtime_dir=configuration.runtime_dir) as bus:
        try:
            live = LiveMap(configuration, bus, vitals, assignment)
        except (MapError, GnssError, ConfigurationError) as error:
            log.error("%s", error)
            return USER_ERROR_STATUS
        realtime.reserve(*HELD_MIB)
        realtime.freeze_objects()
        vitals.beat()
        vitals.count(ready=1)
        bus.declare_alive()
        until_s = None
        while not live.ended and (until_s is None or time.monotonic() < until_s):
            live.turn(TURN_S)
            if stop.asked and until_s is None:
                until_s = time.monotonic() + END_S
        vitals.count(ready=0)  # no beat any more: it closes loops and waits for the disk
        reason = live.finish()
    if reason:
        log.error("%s", reason)
        return DISK_STATUS
    return 0


if __name__ == "__main__":
    run_beside(localise, Assignment, NICENESS)
