"""A process that sends to a router: waits for it, sends until SIGTERM or SIGINT, and reconnects after a loss.

It notifies systemd at once, so that the vehicle does not wait for the network.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from birdslam.runtime.process import signals
from birdslam.runtime.process.notify import STATUS_S, Notifier

REPORT_S = 60.0  # between two messages about a missing router
_Link = TypeVar("_Link")


class RateLimit:
    """Limits the mean rate, without a burst after a pause; without a rate it passes everything."""

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = 0 if rate_hz is None else round(1e9 / rate_hz)
        self._due_ns = 0

    def passes(self, now_ns: int) -> bool:
        """Whether a message may be sent now."""
        late_ns = now_ns - self._due_ns
        if late_ns < 0:
            return False
        self._due_ns = (self._due_ns if late_ns < self._period_ns else now_ns) + self._period_ns
        return True


class Sender(AbstractContextManager["Sender"], Protocol):
    """A context manager that sends while it is entered."""

    pause_s: float  # between two steps

    @property
    def connected(self) -> bool:
        """Whether the router is connected."""

    @property
    def alive(self) -> frozenset[str]:
        """The vehicle's nodes that are alive."""

    def step(self) -> None:
        """Sends what has arrived; does nothing if it sends on its own threads."""


def send(
    name: str,
    who: str,
    router: str,
    connect: Callable[[], _Link],
    missing: type[Exception],
    begin: Callable[[_Link], Sender],
) -> None:
    """Sends until SIGTERM or SIGINT. `connect` raises `missing` while there is no router.

    `name` is the prefix of error messages, `who` of messages about the connection.
    """
    notifier = Notifier()
    notifier.once("READY=1")
    link = _connected(name, router, connect, missing, notifier)
    if link is None:
        return
    reached: bool | None = None
    with begin(link) as sender:
        while True:
            sender.step()
            if (now := sender.connected) != reached:
                reached = now
                state = f"is connected to {router}" if now else f"has lost {router} and is reconnecting"
                print(f"{who} {state}", flush=True)
            notifier.alive(f"router {'connected' if reached else 'LOST'}, {len(sender.alive)} nodes alive")
            if signals.asked_to_end(min(sender.pause_s, notifier.period_s or sender.pause_s)):
                break
        notifier.once("STOPPING=1")


def _connected(
    name: str, router: str, connect: Callable[[], _Link], missing: type[Exception], notifier: Notifier
) -> _Link | None:
    """Returns the link when connected; None after a signal."""
    reported_s = -REPORT_S
    while True:
        try:
            return connect()
        except missing as error:
            if time.monotonic() - reported_s >= REPORT_S:
                reported_s = time.monotonic()
                print(f"birdslam: {name}: {error}", file=sys.stderr, flush=True)
        notifier.alive(f"connecting to {router}")
        if signals.asked_to_end(STATUS_S):  # a refused connection fails at once
            return None
