"""Opens and closes zenoh sessions of the bus: local sockets only, with bounded queues."""

from __future__ import annotations

import atexit
import json
from pathlib import Path
from typing import Any

import zenoh

_URGENT_BATCHES = 16  # zenoh's largest
_LEASE_MS = 1_000  # a planner that is stopped for this time is disconnected, so that it delays no publisher
_RETRY = {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2}
_MAX_ZENOH_BYTES = 1 << 17  # two of the largest messages; zenoh's default is 1 GiB
_MAX_FILTER_BYTES = 65_000  # payload and attachment; zenoh silently drops larger messages, so wire.py rejects them
_PATIENCE_US = 60_000_000  # between the processes of a run, before zenoh closes a silent or full link


def session_config(listen: list[Path], connect: list[Path], patient: bool) -> zenoh.Config:
    """Returns zenoh's configuration with the unix sockets to listen on and to connect to.

    `patient`: for the processes of a run, which the supervisor watches. On a busy computer one of them may get no core
    for seconds, and a closed link would lose the record that ends the run. The death of a process closes its links.
    """
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [f"unixsock-stream/{path}" for path in listen],
        "connect/endpoints": [f"unixsock-stream/{path}" for path in connect],
        "connect/retry": _RETRY,
        "connect/timeout_ms": -1,  # retry forever in the background: the hub may start later or restart
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "transport/link/protocols": ["unixsock-stream"],
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        # Each express message takes a batch: room for those of a few frames while the link's thread waits for a core
        "transport/link/tx/queue/size/real_time": _URGENT_BATCHES,
        "transport/link/rx/max_message_size": _MAX_ZENOH_BYTES,
        "adminspace/enabled": False,
        "low_pass_filter": [
            {
                "id": "size",
                "flows": ["ingress", "egress"],
                "messages": ["put", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": _MAX_FILTER_BYTES,
            }
        ],
    }
    if patient:
        settings["transport/link/tx/queue/congestion_control/block/wait_before_close"] = _PATIENCE_US
        settings["transport/link/tx/lease"] = _PATIENCE_US // 1_000
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Opens a session that is always closed before the interpreter exits. Raises ZError.

    A callback from zenoh's threads into an exiting interpreter crashes the process. An exception or a signal can occur
    between the opening of a session and the `with` or `try` that closes it.
    """
    session = zenoh.open(config)
    atexit.register(session.close)
    return session


def close_session(session: zenoh.Session) -> None:
    """Closes a session of `open_session` and waits for its callbacks. A second call does nothing."""
    session.close()
    atexit.unregister(session.close)
