"""The map process: localises the drive in a map and extends the map; no node waits for it.

`python -m birdslam.runtime.maps.map_process map VITALS_FD PARENT_PID`; standard input: the configuration and an
`Assignment`, one line of JSON each. Ends after END_OF_SOURCE or on SIGTERM. Exit status: 0 complete, 1 bug, 2 unusable
map, 3 disk failure. Saves the map about every ten seconds; a restarted process continues from the last saved one.
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

TURN_S = 0.05  # max. interval between two turns
END_S = 2.0  # after SIGTERM, for END_OF_SOURCE to arrive
HEALTH_NS = 1_000_000_000
WAITING_ESTIMATES = 1024  # queue while a loop is closed
HELD_MIB = 8.0, 46.0  # reserved for small objects and for WAITING_ESTIMATES as bytes and the work on an image
WAITING_IMAGES = 4  # of frames without an estimate yet, the oldest ones
CPU_SHARE = 0.25  # of one core for images; more slows the pipeline down through shared caches, at any priority
SAVE_EVERY_S, MAX_SAVE_RATIO = 10.0, 0.02  # min. interval, and max. share of the time
NICENESS = 10  # below all other processes
SUMMARY = "map.json"  # beside the logs: entries for summary.json

log = logging.getLogger(__name__)


class LiveMap:
    """Localises and maps from the messages of the bus; publishes `map_pose`."""

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
            self._resume()
        else:
            self._last_pose.unlink(missing_ok=True)
        gnss = configuration.results.gnss
        self._fixes: list[GnssFix] = []
        self._receiver = Receiver(gnss) if gnss and is_serial(gnss) else None
        self._recorded = recorded_fixes(configuration)
        self._clock_ns = 0  # of the source less CLOCK_MONOTONIC
        self._newest: MapPose | None = None
        self._saved_epoch = 0  # of the map in the file
        self._next_look_ns = 0  # CLOCK_MONOTONIC, by CPU_SHARE
        self._saved_s, self._save_took_s = time.monotonic(), 0.0
        self._process = psutil.Process()
        self._process.cpu_percent()
        self._reported_ns, self._stepped, self._stepped_reported = time.monotonic_ns(), 0, 0
        self.looks = self.torn = 0
        self.ended = False

    def _resume(self) -> None:
        """Continues from the last pose of the previous process, which is valid while odometry's epoch is the same."""
        try:
            self._drive.resume(decode(self._last_pose.read_bytes(), MapPose))
        except (OSError, WireError) as error:
            log.warning("the last pose of the previous map process is unknown: %s", error)

    def turn(self, timeout_s: float) -> bool:
        """Processes one estimate and the images that have arrived; returns whether there was an estimate."""
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
        """Copies the images that will be processed, since pixels stay in the ring for a few frames only."""
        while (message := self._frames.recv(0.0)) is not None:
            ref: FrameRef = message.record
            if ref.slot < 0 or ref.t_capture_ns < self._next_look_ns or len(self._images) == WAITING_IMAGES:
                continue
            try:
                image = self._ring.read(ref)
                if image is not None:
                    self._images[ref.frame_id] = image
            except FrameError as error:
                log.warning("frame %d is skipped: %s", ref.frame_id, error)
                image = None
            self.torn += image is None

    def _step(self, estimate: Estimate) -> None:
        image = None
        while self._images and next(iter(self._images)) <= estimate.frame_id:
            frame_id, pixels = self._images.popitem(last=False)
            image = pixels if frame_id == estimate.frame_id else None
        start_s = time.process_time()
        looked = image is not None and self._drive.due(estimate)
        found = self._drive.step(estimate, self._undistort(image) if image is not None and looked else None)
        if looked:
            took_ns = (time.process_time() - start_s) * 1e9
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
            self._store_pose(self._newest)

    def _store_pose(self, pose: MapPose) -> None:
        """Stores the pose in the saved map for a restarted process."""
        draft = self._last_pose.with_suffix(".draft")
        try:
            draft.write_bytes(encode(pose))
            draft.replace(self._last_pose)
        except OSError as error:
            log.warning("the pose of the map process can't be stored: %s", error)

    def _save_due(self) -> bool:
        old = self._drive.unsaved or (self._newest is not None and self._newest.map_epoch != self._saved_epoch)
        return old and time.monotonic() - self._saved_s > max(SAVE_EVERY_S, self._save_took_s / MAX_SAVE_RATIO)

    def _save(self) -> None:
        start_s = time.monotonic()
        try:
            self._drive.save()
            if self._newest is not None:
                self._saved_epoch = self._newest.map_epoch
                self._store_pose(self._newest)
        except MapError as error:
            log.warning("%s", error)
        self._saved_s = time.monotonic()
        self._save_took_s = self._saved_s - start_s

    def finish(self) -> str:
        """Ends the drive and writes the map; returns the reason of a failure, or ""."""
        summary: dict[str, Any] = {}
        reason = ""
        try:
            self._drive.end()
        except OSError as failure:
            reason = f"{self._output}: can't be written: {failure.strerror}"
        try:
            summary["map"] = self._drive.summary() | {"looks": self.looks, "torn": self.torn}
            places = self._georeference(summary)
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

    def _georeference(self, summary: dict[str, Any]) -> list[Place]:
        """Returns the drive's places, georeferenced if possible; unusable fixes do not affect the map."""
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
            log.warning("the drive is not georeferenced: %s", error)
            return self._drive.places


def localise(configuration: Configuration, assignment: Assignment, vitals: Vitals, stop: Stop) -> int:
    """Runs the map process; returns its exit status."""
    import faiss  # noqa: F401  # load it before the drive

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
        vitals.count(ready=0)  # no more beats while it closes loops and waits for the disk
        reason = live.finish()
    if reason:
        log.error("%s", reason)
        return DISK_STATUS
    return 0


if __name__ == "__main__":
    run_beside(localise, Assignment, NICENESS)
