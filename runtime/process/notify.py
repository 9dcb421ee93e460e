"""Notifications to systemd (sd_notify(3)): ready, alive, the status line, stopping; and a service's work until then."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping

from birdslam.runtime.process import signals

LOOK_S = 1.0  # how often the status line is written where systemd watches nothing


class Notifier:
    """Sends to the socket that systemd names in the environment; does nothing without one.

    An undeliverable message is dropped; if it is the watchdog's, systemd acts on its timeout.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = int(environment.get("WATCHDOG_USEC") or 0) if for_us else 0
        self.period_s = watchdog_us / 1e6 / 3 if watchdog_us else None  # of `alive`; None: nobody watches
        self._due_s = 0.0
        self._said: set[str] = set()

    def once(self, state: str) -> None:
        """Sends READY=1 or STOPPING=1 once."""
        if state not in self._said:
            self._said.add(state)
            self._send(state)

    def alive(self, status: str) -> None:
        """Sends the watchdog's heartbeat and the status line when they are due."""
        now_s = time.monotonic()
        if self._address and now_s >= self._due_s:
            self._due_s = now_s + min(1.0, self.period_s or 1.0)
            self._send(f"WATCHDOG=1\nSTATUS={status}" if self.period_s else f"STATUS={status}")

    def _send(self, message: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            try:
                out.sendto(message.encode(), self._address)
            except (BlockingIOError, ConnectionError, FileNotFoundError):
                return


def serve(said: str, status: Callable[[], str]) -> None:
    """What a service does whose work goes on by itself: it says that it is open, and waits to be asked to end."""
    notifier = Notifier()
    print(said, flush=True)
    notifier.once("READY=1")
    while not signals.asked_to_end(notifier.period_s or LOOK_S):
        notifier.alive(status())
    notifier.once("STOPPING=1")
