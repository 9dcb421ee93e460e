"""The runtime directory of a vehicle with its sockets, its ring of frames, and the lock for one instance.

The directory is `$XDG_RUNTIME_DIR/birdslam/<vehicle>`, or `/tmp/birdslam-<uid>/<vehicle>` without that variable. It
is private to one user (0700). Without /dev/shm it also holds the frames.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

from birdslam.runtime.topology import check_name
from birdslam.runtime.transport.closing import Closing

_MAX_SOCKET_PATH_BYTES = 107  # sun_path of Linux, without its final zero
_SHARED_MEMORY = Path("/dev/shm")
_OWN = "own-"  # followed by a PID: the private runtime directory of a run over a recording


class VehicleBusy(RuntimeError):
    """Another instance of this vehicle runs; the message names its process and lock file."""


def runtime_dir_of(vehicle: str, runtime_dir: Path | None = None) -> Path:
    """Returns the vehicle's directory inside `runtime_dir`; creates it if needed.

    Raises ValueError for an invalid vehicle name, PermissionError if other users can access the directory.
    """
    check_name("vehicle", vehicle)
    directory = (_users_runtime_dir() if runtime_dir is None else runtime_dir) / vehicle
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    _check_private(directory)
    return directory.resolve()


def _users_runtime_dir() -> Path:
    session_dir = os.environ.get("XDG_RUNTIME_DIR")
    directory = Path(session_dir, "birdslam") if session_dir else Path(f"/tmp/birdslam-{os.getuid()}")
    directory.mkdir(mode=0o700, exist_ok=True)
    _check_private(directory)
    return directory


@contextlib.contextmanager
def own_runtime_dir(vehicle: str) -> Iterator[Path]:
    """Creates a temporary runtime directory, hence a private bus, for this process.

    Runs over recordings can then run in parallel, and beside a vehicle of the same name. Also removes the directories
    of killed processes.
    """
    place = _users_runtime_dir()
    for left in place.glob(f"{_OWN}*"):
        if not _runs(left.name.removeprefix(_OWN)):
            _remove_left(left)
    directory = place / f"{_OWN}{os.getpid()}"
    directory.mkdir(mode=0o700, exist_ok=True)
    try:
        yield directory
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def _runs(pid: str) -> bool:
    return not pid.isdigit() or Path("/proc", pid).exists()


def _remove_left(directory: Path) -> None:
    for lock in directory.glob("*/lock"):
        try:
            VehicleLock(lock.parent.name, directory).close()  # its sockets and its ring
        except (VehicleBusy, OSError, ValueError):  # of another container with its own PIDs
            return
    shutil.rmtree(directory, ignore_errors=True)


def _check_private(directory: Path) -> None:
    state = directory.lstat()
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise PermissionError(
            f"the runtime directory {directory} must be a directory of user {os.getuid()} alone (mode 0700); "
            f"it is {stat.filemode(state.st_mode)} of user {state.st_uid}"
        )


def socket_path(directory: Path, name: str) -> Path:
    """Returns the path of a unix socket in a runtime directory. Raises ValueError if it is too long."""
    path = directory / f"{name}.sock"
    if (size := len(os.fsencode(path))) > _MAX_SOCKET_PATH_BYTES:
        raise ValueError(
            f"the socket {path} has a path of {size} B, over the {_MAX_SOCKET_PATH_BYTES} B of a unix socket: "
            "choose a shorter runtime directory"
        )
    return path


def findings_path(directory: Path) -> Path:
    """Returns the path of the networks' findings of an earlier pass, in a private runtime directory."""
    return directory / "findings.msgpack"


def ring_path(vehicle: str, runtime_dir: Path | None = None) -> Path:
    """Returns the path of a vehicle's ring of frames: in shared memory, else in its runtime directory."""
    directory = runtime_dir_of(vehicle, runtime_dir)
    if not os.access(_SHARED_MEMORY, os.W_OK):
        return directory / "frames.ring"
    place = hashlib.sha256(os.fsencode(directory)).hexdigest()[:8]  # one ring per runtime directory
    return _SHARED_MEMORY / f"birdslam-{os.getuid()}-{vehicle}-{place}.ring"


class VehicleLock(Closing):
    """A lock for one running instance per vehicle name. A context manager, held by the supervisor.

    The kernel releases it when the process dies. Its new owner removes the files of dead processes. Raises VehicleBusy
    if another process holds it. A forked child would keep it: spawn instead.
    """

    def __init__(self, vehicle: str, runtime_dir: Path | None = None) -> None:
        directory = runtime_dir_of(vehicle, runtime_dir)
        self.path = directory / "lock"
        self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(self._fd, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(self._fd)
            raise VehicleBusy(f"vehicle {vehicle!r} already runs: process {holder}, lock file {self.path}") from error
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)
        self._directory, self._ring = directory, ring_path(vehicle, runtime_dir)
        self._clean()

    def _clean(self) -> None:
        _remove_dead_sockets(self._directory)
        self._ring.unlink(missing_ok=True)

    def close(self) -> None:
        """Removes the files of killed nodes and releases the lock; a second call does nothing."""
        if self._fd >= 0:
            self._clean()
            os.ftruncate(self._fd, 0)
            os.close(self._fd)
            self._fd = -1


def _remove_dead_sockets(directory: Path) -> None:
    """Removes sockets without a listener; a process that outlived its supervisor keeps its socket."""
    for path in directory.glob("*.sock"):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            try:
                probe.connect(os.fsencode(path))
            except (ConnectionRefusedError, FileNotFoundError):
                _remove_socket(path)


def remove_socket(directory: Path, name: str) -> None:
    """Removes the socket of a dead process."""
    _remove_socket(socket_path(directory, name))


def _remove_socket(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.with_name(path.name + ".lock").unlink(missing_ok=True)
