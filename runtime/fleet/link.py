"""Opens a zenoh session to the fleet's router with mutual TLS, after checking its configuration."""

from __future__ import annotations

import json
import os
from typing import Any

import zenoh

from birdslam.runtime.configuration import ConfigurationError, FleetConfig, RouterConfig
from birdslam.runtime.transport.bus import BusError
from birdslam.runtime.transport.session import open_session
from birdslam.runtime.wire import MAX_MESSAGE_BYTES

LEASE_MS = 1_000  # a silent peer is disconnected after this time
MAX_ZENOH_BYTES = 2 * MAX_MESSAGE_BYTES + 4096  # zenoh's default is 1 GiB
_URGENT_BATCHES = 16  # zenoh's largest
_BUFFER_BYTES = 1 << 18  # of the socket, each way; the default would queue seconds of old estimates
BUFFERS = {"so_sndbuf": _BUFFER_BYTES, "so_rcvbuf": _BUFFER_BYTES}
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}


def settings_of(mode: str) -> dict[str, Any]:
    """Returns the zenoh settings of both sides: TLS only, without discovery, with bounded queues."""
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
    """Raises ConfigurationError with the key if the address is not TLS or a file can't be read."""
    address = getattr(config, address_key)
    if not address.startswith("tls/"):
        raise ConfigurationError(f"{table}.{address_key}: needs tls/HOST:PORT, got {address!r}")
    for key in ("ca", "certificate", "key"):
        file = getattr(config, key)
        if not file or not os.access(file, os.R_OK):
            raise ConfigurationError(f"{table}.{key}: {file or 'nothing'} can't be read")


def zenoh_config(settings: dict[str, Any]) -> zenoh.Config:
    """Converts the settings to zenoh's configuration."""
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def open_link(config: FleetConfig, timeout_s: float) -> zenoh.Session:
    """Opens a session to the router, which reconnects after a loss.

    Raises ConfigurationError for an invalid table, BusError without a connection in time.
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
        reason = "check that the router runs and that its authority signed this certificate"
        raise BusError(f"fleet.router {config.router}: no connection within {timeout_s:g} s: {reason}") from error
