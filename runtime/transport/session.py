"""How a session of the bus is set up: local and bounded; nothing of zenoh's defaults that opens or grows.

And how sessions end: before Python does.
"""

from __future__ import annotations

import atexit
import json
from pathlib import Path
from typing import Any

import zenoh

_URGENT_BATCHES = 16  # zenoh's largest
_LEASE_MS = 1_000  # a stopped or unreachable peer is given up after this
_RETRY = {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2}
_MAX_ZENOH_BYTES = 1 << 17  # zenoh would put together 1 GiB; room for two of our largest messages
_FILTER_BYTES = 65_000  # payload and attachment together; zenoh drops what is larger, so wire.py refuses it before
_LOSSLESS_PATIENCE_US = 60_000_000  # how long a blocked put may wait before zenoh gives the link up


def session_config(listen: list[Path], connect: list[Path], lossless: bool) -> zenoh.Config:
    """Of zenoh: unix sockets alone, to listen on and to connect to."""
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [f"unixsock-stream/{path}" for path in listen],
        "connect/endpoints": [f"unixsock-stream/{path}" for path in connect],
        "connect/retry": _RETRY,
        "connect/timeout_ms": -1,  # retry in the background for ever: the hub may come later, and again
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "transport/link/protocols": ["unixsock-stream"],
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        # Express messages go in batches of their own: room for those of a few frames while the link's thread waits for
        # the processor, else a burst of three is dropped.
        "transport/link/tx/queue/size/real_time": _URGENT_BATCHES,
        "transport/link/rx/max_message_size": _MAX_ZENOH_BYTES,
        "adminspace/enabled": False,
        "low_pass_filter": [
            {
                "id": "size",
                "flows": ["ingress", "egress"],
                "messages": ["put", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": _FILTER_BYTES,
            }
        ],
    }
    if lossless:  # who gets no processor for seconds loses no message by it; who dies is still noticed at once
        settings["transport/link/tx/queue/congestion_control/block/wait_before_close"] = _LOSSLESS_PATIENCE_US
        settings["transport/link/tx/lease"] = _LOSSLESS_PATIENCE_US // 1_000
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def open_session(config: zenoh.Config) -> zenoh.Session:
    """A session that is closed before Python ends, however that comes about. Raises ZError.

    A callback that zenoh's threads make into an interpreter that is ending, or has ended, panics or ends the process
    with a segmentation fault. An exception or a signal may come between the opening of a session and the `with` or
    the `try` that closes it.
    """
    session = zenoh.open(config)
    atexit.register(session.close)
    return session


def close_session(session: zenoh.Session) -> None:
    """Closes a session of `open_session`; when this returns, no callback of it runs. A second call does nothing."""
    session.close()
    atexit.unregister(session.close)
