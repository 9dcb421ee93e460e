"""The process of a node: start, pidfd, log, and the reason for its end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.environment import ENVIRONMENT, USER_ERROR_STATUS
from birdslam.runtime.process.vitals import Vitals

_REPORTED_LEVELS = (" WARNING ", " ERROR ", " CRITICAL ")


class NodeLog:
    """`logs/<node>.log`: the output of all processes of a node."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read = 0
        path.write_bytes(b"")

    def new_warnings(self) -> list[str]:
        """Returns the lines logged as warnings or worse since the last call."""
        with self.path.open("rb") as log:
            log.seek(self._read)
            whole, newline, _ = log.read().rpartition(b"\n")
        self._read += len(whole) + len(newline)
        lines = whole.decode(errors="replace").splitlines()
        return [_message(line) for line in lines if any(level in line for level in _REPORTED_LEVELS)]

    def size(self) -> int:
        """Returns the size in bytes."""
        return self.path.stat().st_size

    def lines(self, start: int) -> list[str]:
        """Returns the non-empty lines from byte `start` on."""
        with self.path.open("rb") as log:
            log.seek(start)
            return [line for line in log.read().decode(errors="replace").splitlines() if line.strip()]


class NodeProcess:
    """One process of a node: loads its dependencies at once, then waits for `begin`."""

    def __init__(
        self, name: str, configuration: Configuration, log: NodeLog, module: str = "birdslam.runtime.nodes.runner"
    ) -> None:
        self.name = name
        self.vitals = Vitals()
        self.begun_s: float | None = None
        self._log, self._log_start = log, log.size()
        with log.path.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, name, str(self.vitals.fd), str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **ENVIRONMENT},
                pass_fds=(self.vitals.fd,),
                start_new_session=True,  # Ctrl-C at the terminal goes to the supervisor alone, which relays it
            )
        self.pidfd = os.pidfd_open(self._process.pid)
        self._send(configuration)

    def begin(self, assignment: msgspec.Struct) -> None:
        """Sends the assignment, which starts its work."""
        self.begun_s = time.monotonic()
        self._send(assignment)
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            return  # it died at once: its pidfd says so

    def _send(self, what: msgspec.Struct) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(msgspec.json.encode(what) + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return  # it died at once: its pidfd says so

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit_status(self) -> int | None:
        """Like Popen.returncode: negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def ready(self) -> bool:
        """Whether it has started its work."""
        return bool(self.vitals["ready"])

    def silent_s(self) -> float:
        """Returns the time since the last heartbeat in s; 0 before it is ready."""
        return (time.monotonic_ns() - self.vitals["beat_ns"]) / 1e9 if self.ready else 0.0

    def send(self, number: signal.Signals) -> None:
        """Sends a signal if it still runs."""
        if self.exit_status is None:
            self._process.send_signal(number)

    def how(self) -> str:
        """Returns how it ended."""
        status = self.exit_status
        if status is not None and status < 0:
            return f"was killed by {signal.Signals(-status).name}"
        return f"failed with exit status {status}" if status else "ended before its source did"

    def failure(self, cause: str = "", then: str = "") -> str:
        """Returns a message: why it ended (`cause`, else `how`), the consequence `then`, the last line of its log."""
        lines = self._log.lines(self._log_start)
        if self.exit_status == USER_ERROR_STATUS and not then:
            errors = [line for line in lines if " ERROR " in line]
            return _message(errors[-1]) if errors else f"{self.name} can't use its configuration"
        last = f"; its last line: {_message(lines[-1].strip())}" if lines else ""
        return f"{self.name} {cause or self.how()}{then}{last} (log: {self._log.path})"

    def close(self) -> None:
        """Kills the process if it still runs, and releases its resources."""
        self.send(signal.SIGKILL)
        self._process.wait()
        if self.begun_s is None and self._process.stdin is not None:
            self._process.stdin.close()
        os.close(self.pidfd)
        self.vitals.close()


def waited_s(pid: int) -> dict[int, float]:
    """Returns the time that each thread of a process has waited for a core; empty if Linux does not report it.

    All threads count, since any of them may hold the interpreter's lock while it waits.
    """
    found = {}
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            found[int(path.parent.name)] = int(path.read_text().split()[1]) / 1e9
        except (OSError, IndexError):  # the thread has just ended
            continue
    return found


def _message(line: str) -> str:
    """Returns a log line without its date and level."""
    for level in _REPORTED_LEVELS:
        if level in line:
            return line.partition(level)[2]
    return line
