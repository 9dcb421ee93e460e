"""The process of a sender: it waits for its router, sends until it is asked to end, and lives through the router's end.

Its vehicle waits for no network: it notifies systemd at once.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from birdslam.runtime.process import signals
from birdslam.runtime.process.notify import LOOK_S, Notifier

REPORT_S = 60.0  # between two lines that say that there is no router
_Link = TypeVar("_Link")


class RateLimit:
    """Lets so many a second through in the mean, and no burst after a pause; without a rate everything."""

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = 0 if rate_hz is None else round(1e9 / rate_hz)
        self._due_ns = 0

    def passes(self, now_ns: int) -> bool:
        """Whether what is to be sent now is sent."""
        late_ns = now_ns - self._due_ns
        if late_ns < 0:
            return False
        self._due_ns = (self._due_ns if late_ns < self._period_ns else now_ns) + self._period_ns
        return True


class Sender(AbstractContextManager["Sender"], Protocol):
    """What sends while it is entered."""

    pause_s: float  # between two steps

    @property
    def connected(self) -> bool:
        """Whether the router is there now."""

    @property
    def alive(self) -> frozenset[str]:
        """The vehicle's nodes that are alive."""

    def step(self) -> None:
        """Sends what has come; nothing to do for one that sends on threads of its own."""


def send(
    name: str,
    who: str,
    router: str,
    connect: Callable[[], _Link],
    missing: type[Exception],
    begin: Callable[[_Link], Sender],
) -> None:
    """Until SIGTERM or SIGINT. `connect` raises `missing` while there is no router.

    `name` stands in lines of standard error, `who` in those that say that the router was reached or lost.
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
                state = f"is connected to {router}" if now else f"has lost {router} and looks for it"
                print(f"{who} {state}", flush=True)
            notifier.alive(f"router {'reached' if reached else 'GONE'}, {len(sender.alive)} nodes alive")
            if signals.asked_to_end(min(sender.pause_s, notifier.period_s or sender.pause_s)):
                break
        notifier.once("STOPPING=1")


def _connected(
    name: str, router: str, connect: Callable[[], _Link], missing: type[Exception], notifier: Notifier
) -> _Link | None:
    """The link, as soon as it can be had; None where a signal came first."""
    reported_s = -REPORT_S
    while True:
        try:
            return connect()
        except missing as error:
            if time.monotonic() - reported_s >= REPORT_S:
                reported_s = time.monotonic()
                print(f"birdslam: {name}: {error}", file=sys.stderr, flush=True)
        notifier.alive(f"looks for {router}")
        if signals.asked_to_end(LOOK_S):  # a refusal may come at once
            return None
