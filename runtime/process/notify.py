"""Notifications to systemd (sd_notify(3)): ready, watchdog, status line, stopping."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping

from birdslam.runtime.process import signals

STATUS_S = 1.0  # period of the status line without a watchdog


class Notifier:
    """Sends to the socket that systemd names in the environment; does nothing without one.

    An undeliverable message is dropped; if it is the watchdog's, systemd acts on its timeout.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = int(environment.get("WATCHDOG_USEC") or 0) if for_us else 0
        self.period_s = watchdog_us / 1e6 / 3 if watchdog_us else None  # of `alive`; None: no watchdog
        self._due_s = 0.0
        self._sent: set[str] = set()

    def once(self, state: str) -> None:
        """Sends READY=1 or STOPPING=1 once."""
        if state not in self._sent:
            self._sent.add(state)
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


def serve(greeting: str, status: Callable[[], str]) -> None:
    """Prints the greeting, notifies systemd, and waits for SIGTERM or SIGINT while other threads do the work."""
    notifier = Notifier()
    print(greeting, flush=True)
    notifier.once("READY=1")
    while not signals.asked_to_end(notifier.period_s or STATUS_S):
        notifier.alive(status())
    notifier.once("STOPPING=1")
