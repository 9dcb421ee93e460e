"""Waiting for a signal that ends a process."""

from __future__ import annotations

import signal

ENDING = frozenset({signal.SIGTERM, signal.SIGINT})


def block() -> None:
    """Keeps SIGTERM and SIGINT for `asked_to_end`; before any other thread is there, since those inherit it."""
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)


def asked_to_end(timeout_s: float) -> bool:
    """Whether one of the two came within the time; they are blocked (`block`).

    A process that was stopped (SIGSTOP) and goes on after the time-out gets a result
    from Python in which nothing is set: only a number that was asked for counts.
    """
    found = signal.sigtimedwait(ENDING, timeout_s)
    return found is not None and found.si_signo in ENDING
