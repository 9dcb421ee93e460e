"""Waiting for a signal that ends a process."""

from __future__ import annotations

import signal

ENDING = frozenset({signal.SIGTERM, signal.SIGINT})


def block() -> None:
    """Blocks SIGTERM and SIGINT for `asked_to_end`; call it before other threads start, which inherit the mask."""
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)


def asked_to_end(timeout_s: float) -> bool:
    """Whether SIGTERM or SIGINT arrives within the time; both must be blocked (`block`).

    After SIGSTOP and SIGCONT Python may return an empty result, so the signal number is checked.
    """
    found = signal.sigtimedwait(ENDING, timeout_s)
    return found is not None and found.si_signo in ENDING
