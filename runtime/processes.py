"""A node's process as the supervisor holds it: started, watched by a pidfd, and asked for its last words."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec

from runtime.cli import THREAD_LIMITS, USER_ERROR_STATUS
from runtime.configuration import Configuration
from runtime.vitals import Vitals

_SHOWN_LEVELS = (" WARNING ", " ERROR ", " CRITICAL ")


class NodeProcess:
    """One node, started at once. Its standard output and error go to `logs/<node>.log` in the output folder."""

    def __init__(self, name: str, configuration: Configuration, directory: Path) -> None:
        self.name = name
        self.vitals = Vitals()
        self.log_path = directory / f"{name}.log"
        self._log_read = 0
        with self.log_path.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "runtime.runner", name, str(self.vitals.fd), str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **THREAD_LIMITS},
                pass_fds=(self.vitals.fd,),
                start_new_session=True,  # Ctrl-C at the terminal goes to the supervisor alone, which relays it
            )
        self.pidfd = os.pidfd_open(self._process.pid)
        assert self._process.stdin is not None
        try:
            with self._process.stdin as stdin:
                stdin.write(msgspec.json.encode(configuration))
        except BrokenPipeError:
            return  # it died at once: its pidfd says so

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit_status(self) -> int | None:
        """As of Popen.returncode: negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def ready(self) -> bool:
        """It has said, once, that it is at work."""
        return bool(self.vitals["ready"])

    def silent_s(self) -> float:
        """How long its loop has shown no life; 0 before it is ready."""
        return (time.monotonic_ns() - self.vitals["beat_ns"]) / 1e9 if self.ready else 0.0

    def send(self, number: signal.Signals) -> None:
        """A signal, where it still runs."""
        if self.exit_status is None:
            self._process.send_signal(number)

    def new_warnings(self) -> list[str]:
        """Lines that it has logged as warnings or worse since the last call."""
        with self.log_path.open("rb") as log:
            log.seek(self._log_read)
            whole, newline, _ = log.read().rpartition(b"\n")
        self._log_read += len(whole) + len(newline)
        lines = whole.decode(errors="replace").splitlines()
        return [_message(line) for line in lines if any(level in line for level in _SHOWN_LEVELS)]

    def failure(self) -> str:
        """Why it ended, for a person: exit status or signal, and its last words."""
        status = self.exit_status
        lines = [line for line in self.log_path.read_text(errors="replace").splitlines() if line.strip()]
        if status == USER_ERROR_STATUS:
            errors = [line for line in lines if " ERROR " in line]
            return _message(errors[-1]) if errors else f"{self.name} can't use its configuration"
        if status is not None and status < 0:
            how = f"was killed by {signal.Signals(-status).name}"
        else:
            how = f"failed with exit status {status}"
        last = f"; its last line: {_message(lines[-1].strip())}" if lines else ""
        return f"{self.name} {how}{last} (log: {self.log_path})"

    def close(self) -> None:
        """Kills what still runs, and lets go of it."""
        self.send(signal.SIGKILL)
        self._process.wait()
        os.close(self.pidfd)
        self.vitals.close()


def _message(line: str) -> str:
    """A log line without its date and level."""
    for level in _SHOWN_LEVELS:
        if level in line:
            return line.partition(level)[2]
    return line
