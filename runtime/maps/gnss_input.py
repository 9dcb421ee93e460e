"""Sources of GNSS fixes: a file, a ROS topic, or a receiver on a serial line.

`FILE` (CSV, NMEA, GPX; see birdslam/loops/gnss/files.py), `topic:/NAME` (sensor_msgs/NavSatFix) of the drive's bag or
of live ROS 2, `/dev/TTY[@BAUD]` (NMEA 0183). Fixes of a serial line have their time of arrival; the delay is estimated.
"""

from __future__ import annotations

import logging
import math
import os
import select
import stat
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

from birdslam.loops.gnss.earth import DEFAULT_SIGMA_M, GnssFix
from birdslam.loops.gnss.files import GNSS_FILE, MAX_BYTES, MAX_FIXES, GnssError, Track, checked_fix, read_track
from birdslam.loops.gnss.sentences import NmeaReader, Sentence
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.schemes import ROS, all_schemes
from birdslam.sources.recording import DatasetError
from birdslam.sources.rosbag import RosbagRecording
from birdslam.sources.schemes import scheme_of

TOPIC, BAG, NAV_SAT_FIX = "topic:", "rosbag", "sensor_msgs/NavSatFix"
BAUD = 9600  # default of NMEA 0183 receivers
MAX_LINE_BYTES = 512  # the limit of NMEA is 82
REOPEN_S = 1.0

log = logging.getLogger(__name__)

Fixes = Callable[[int], Track]  # argument: first time of the recording in ns; raises GnssError


def is_serial(name: str) -> bool:
    """Whether the name is a device, not a file."""
    try:
        return stat.S_ISCHR(os.stat(name.partition("@")[0]).st_mode)
    except OSError:
        return name.startswith("/dev/")


def recorded_fixes(configuration: Configuration) -> Fixes | None:
    """Returns the fixes of a file or a bag; None for a receiver or no GNSS. Raises ConfigurationError, GnssError."""
    name = configuration.results.gnss
    if not name or is_serial(name):
        return None
    if name.startswith(TOPIC) and scheme_of(configuration.source.uri, all_schemes()) is ROS:
        return lambda begin_ns: _written_live(Path(configuration.output) / GNSS_FILE, begin_ns)
    if name.startswith(TOPIC):
        found = _of_bag(configuration, name.removeprefix(TOPIC))
        return lambda begin_ns: Track(found)
    return fixes_of_file(Path(name).expanduser(), configuration.results.gnss_offset_s)


def fixes_of_file(path: Path, offset_s: float | None = None) -> Fixes:
    """Reads a file of fixes; `offset_s` as in `read_track`. Raises GnssError."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise GnssError(f"{path}: can't be read: {error.strerror}") from None
    read_track(data, str(path), 0, offset_s)  # raises errors before the drive
    return lambda begin_ns: read_track(data, str(path), begin_ns, offset_s)


def _written_live(path: Path, begin_ns: int) -> Track:
    """Returns the fixes that the source wrote during the drive (runtime/ros/camera.py)."""
    if not path.is_file():
        raise GnssError(f"{path}: no fix was received")
    return read_track(path.read_bytes(), str(path), begin_ns)


def _of_bag(configuration: Configuration, topic: str) -> list[GnssFix]:
    """Returns the fixes with their reported covariance; a status below zero is no fix."""
    scheme, _, path = configuration.source.uri.partition(":")
    if scheme != BAG:
        raise ConfigurationError(f"results.gnss: {TOPIC}{topic}: the source is not a ROS bag")
    try:
        messages = RosbagRecording(Path(path), configuration.camera, topics=configuration.source.topics).timed(
            topic, NAV_SAT_FIX
        )
    except DatasetError as error:
        raise GnssError(str(error)) from None
    out = []
    for t_ns, message in messages:
        if message.status.status < 0:
            continue
        known = message.position_covariance_type > 0
        variance = float(message.position_covariance[0] + message.position_covariance[4]) / 2.0
        sigma_m = math.sqrt(variance) if known and variance > 0.0 else DEFAULT_SIGMA_M
        out.append(checked_fix(f"{path}: {topic}", t_ns, message.latitude, message.longitude, sigma_m, None))
    if not out:
        raise GnssError(f"{path}: {topic}: has no fix")
    return out


class Receiver:
    """A receiver on a serial line, read in a thread: `take` returns the fixes since the last call.

    Reconnects after it was unplugged. Its lines are untrusted; invalid ones are skipped and counted.
    """

    def __init__(self, name: str) -> None:
        """Raises ConfigurationError if the line can't be opened."""
        self._path, _, baud = name.partition("@")
        speed = getattr(termios, f"B{baud or BAUD}", None)
        if speed is None:
            raise ConfigurationError(f"results.gnss: {name}: a serial line has no {baud} baud")
        self._speed: int = speed
        self.refused = 0  # invalid lines
        self._fixes: list[tuple[int, Sentence]] = []
        self._lock = threading.Lock()
        self._stop = os.eventfd(0)
        try:
            first = self._open()
        except OSError as error:
            raise ConfigurationError(f"results.gnss: {self._path}: can't be opened: {error.strerror}") from None
        self._thread = threading.Thread(target=self._run, args=(first,), name="gnss", daemon=True)
        self._thread.start()

    def _open(self) -> int:
        fd = os.open(self._path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            mode = termios.tcgetattr(fd)
            mode[:4] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0]  # raw bytes, eight bits
            mode[4] = mode[5] = self._speed
            termios.tcsetattr(fd, termios.TCSANOW, mode)
        except termios.error as error:
            os.close(fd)
            raise OSError(error.args[0], f"is not a serial line: {error.args[1]}") from None
        return fd

    def _run(self, fd: int | None) -> None:
        while fd is not None or not select.select([self._stop], [], [], REOPEN_S)[0]:
            try:
                fd = self._open() if fd is None else fd
                if self._listen(fd):
                    os.close(fd)
                    return
                os.close(fd)
            except OSError:
                log.debug("%s is disconnected", self._path)
            fd = None

    def _listen(self, fd: int) -> bool:
        """Reads until the receiver is unplugged; returns True after `close`."""
        reader, rest = NmeaReader(), b""
        arrived_ns = 0  # arrival of the first line of the current fix
        while True:
            ready = select.select([fd, self._stop], [], [])[0]
            if self._stop in ready:
                return True
            now_ns = time.monotonic_ns()
            try:
                data = os.read(fd, 4096)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                log.warning("%s: the GNSS receiver is disconnected", self._path)
                return False
            *lines, rest = (rest + data).split(b"\n")
            rest = rest[-MAX_LINE_BYTES:]
            for line in lines:
                arrived_ns = self._take_line(reader, line, arrived_ns, now_ns)

    def _take_line(self, reader: NmeaReader, line: bytes, arrived_ns: int, now_ns: int) -> int:
        started = reader.waits
        try:
            found = reader.take(line[:MAX_LINE_BYTES].decode("ascii", errors="replace"))
        except ValueError:
            self.refused += 1
            return arrived_ns
        if found is not None:
            with self._lock:
                self._fixes.append((arrived_ns, found))
                del self._fixes[:-MAX_FIXES]
        return now_ns if reader.waits != started else arrived_ns

    def take(self, offset_ns: int) -> list[GnssFix]:
        """Returns new fixes; `offset_ns`: the recording's clock less CLOCK_MONOTONIC."""
        with self._lock:
            found, self._fixes = self._fixes, []
        out = []
        for arrived_ns, (_, latitude_deg, longitude_deg, sigma_m, speed_mps) in found:
            try:
                out.append(
                    checked_fix(self._path, arrived_ns + offset_ns, latitude_deg, longitude_deg, sigma_m, speed_mps)
                )
            except GnssError:
                self.refused += 1
        return out

    def close(self) -> None:
        """Ends the thread."""
        os.eventfd_write(self._stop, 1)
        self._thread.join()
        os.close(self._stop)
