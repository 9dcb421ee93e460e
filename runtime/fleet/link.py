"""A session at the fleet's router, by mutual TLS; what it needs, checked before it is opened."""

from __future__ import annotations

import json
import os
from typing import Any

import zenoh

from birdslam.runtime.configuration import ConfigurationError, FleetConfig, RouterConfig
from birdslam.runtime.transport.bus import BusError
from birdslam.runtime.transport.session import open_session
from birdslam.runtime.wire import MAX_MESSAGE_BYTES

LEASE_MS = 1_000  # who has said nothing for so long is gone
MAX_ZENOH_BYTES = 2 * MAX_MESSAGE_BYTES + 4096  # zenoh would put together 1 GiB
_URGENT_BATCHES = 16  # zenoh's largest
# Of the socket, each way: the system's own would hold seconds of estimates for a listener that reads too slowly, all of
# them old when they are read; what does not fit is dropped by the router
_BUFFER_BYTES = 1 << 18
BUFFERS = {"so_sndbuf": _BUFFER_BYTES, "so_rcvbuf": _BUFFER_BYTES}
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}


def settings_of(mode: str) -> dict[str, Any]:
    """zenoh's settings that both sides have in common: TLS alone, nothing that opens or grows."""
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/protocols": ["tls"],
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/size/real_time": _URGENT_BATCHES,
        "transport/link/rx/max_message_size": MAX_ZENOH_BYTES,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": False,
    }


def check(table: str, config: FleetConfig | RouterConfig, address_key: str) -> None:
    """Raises ConfigurationError, which names the key, where the address is no TLS one or a file can't be read."""
    address = getattr(config, address_key)
    if not address.startswith("tls/"):
        raise ConfigurationError(f"{table}.{address_key}: needs tls/HOST:PORT, got {address!r}")
    for key in ("ca", "certificate", "key"):
        file = getattr(config, key)
        if not file or not os.access(file, os.R_OK):
            raise ConfigurationError(f"{table}.{key}: {file or 'nothing'} can't be read")


def zenoh_config(settings: dict[str, Any]) -> zenoh.Config:
    """The settings as zenoh takes them."""
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def open_link(config: FleetConfig, timeout_s: float) -> zenoh.Session:
    """A session at the router, which finds it again when it was gone.

    Raises ConfigurationError for a table that can't be, BusError where nobody lets it in within the time.
    """
    check("fleet", config, "router")
    settings = settings_of("client") | {
        "connect/endpoints": [config.router],
        "connect/timeout_ms": round(1e3 * timeout_s),
        "connect/exit_on_failure": True,
        "connect/retry": _RETRY,
        "transport/link/tls": {
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "root_ca_certificate": config.ca,
            "connect_certificate": config.certificate,
            "connect_private_key": config.key,
            **BUFFERS,
        },
    }
    try:
        return open_session(zenoh_config(settings))
    except zenoh.ZError as error:
        reason = "is the router there, and is this certificate of its authority?"
        raise BusError(f"fleet.router {config.router}: no connection within {timeout_s:g} s: {reason}") from error
