"""The gate: read-only access to a vehicle's estimates for planners on other machines, by mutual TLS.

    python -m birdslam.runtime.gate /etc/birdslam/vehicle.toml /etc/birdslam/gate.json5 --runtime-dir /run/birdslam

A zenoh session that forwards what its file allows (deploy/gate.json5: address, certificates, access control). Only the
car may write its speed, by its own certificate. Exit status: 0 after SIGTERM; 2 for a file that is not restrictive.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import zenoh

from birdslam.runtime.configuration import ConfigurationError, load
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.process import signals
from birdslam.runtime.process.notify import serve
from birdslam.runtime.topology import CAR, PROCESSES, VERSION
from birdslam.runtime.transport.presence import runtime_dir_of, socket_path
from birdslam.runtime.wire import MAX_MESSAGE_BYTES

_RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}
_MUST_BE = {  # key -> its only value
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/tls/enable_mtls": True,
    "transport/shared_memory/enabled": False,
    "adminspace/enabled": False,
    "access_control/enabled": True,
    "access_control/default_permission": "deny",
}
_WRITING = {"put", "delete", "declare_queryable", "reply", "liveliness_token"}  # incoming messages
_CAR_NAME = "the car"  # common name of the only certificate that may write
_CAR_KEYS = tuple(zenoh.KeyExpr(f"birdslam/*/{VERSION}/{topic}") for topic in CAR.sends)
_MAX_ZENOH_BYTES = 2 * MAX_MESSAGE_BYTES + 4096


class GateError(ConfigurationError):
    """The gate's file is not restrictive or invalid; the message names the file, the key and the reason."""


def gate_config(path: Path, vehicle: str, runtime_dir: Path | None = None) -> zenoh.Config:
    """Returns the checked file with the sockets of the vehicle's nodes. Raises GateError."""
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise GateError(f"{path}: {error}") from error
    for key, wanted in _MUST_BE.items():
        if (found := _get(config, key)) != wanted:
            raise GateError(f"{path}: {key}: a gate needs {json.dumps(wanted)}, got {json.dumps(found)}")
    _check_endpoints(path, config)
    _check_rules(path, config)
    try:
        directory = runtime_dir_of(vehicle, runtime_dir)
        endpoints = [f"unixsock-stream/{socket_path(directory, node)}" for node in ("hub", *PROCESSES)]
    except (ValueError, OSError) as error:
        raise GateError(f"vehicle {vehicle!r}, runtime directory: {error}") from error
    for key, value in (
        ("connect/endpoints", endpoints),
        ("connect/retry", _RETRY),
        ("connect/timeout_ms", -1),  # the vehicle may start later or restart
    ):
        config.insert_json5(key, json.dumps(value))
    return config


def _get(config: zenoh.Config, key: str) -> Any:
    try:
        return json.loads(config.get_json(key))
    except zenoh.ZError:  # not in the file
        return None


def _check_endpoints(path: Path, config: zenoh.Config) -> None:
    listen = _get(config, "listen/endpoints")
    if not (isinstance(listen, list) and listen and all(str(end).startswith("tls/") for end in listen)):
        raise GateError(f"{path}: listen/endpoints: a gate listens on tls/... alone, got {json.dumps(listen)}")
    if set(_get(config, "transport/link/protocols") or ()) != {"tls", "unixsock-stream"}:
        raise GateError(f'{path}: transport/link/protocols: a gate needs ["tls", "unixsock-stream"]')
    size = _get(config, "transport/link/rx/max_message_size")
    if not size or size > _MAX_ZENOH_BYTES:
        raise GateError(f"{path}: transport/link/rx/max_message_size: at most {_MAX_ZENOH_BYTES} B, got {size}")
    for key in ("root_ca_certificate", "listen_certificate", "listen_private_key"):
        file = _get(config, f"transport/link/tls/{key}")
        if not file or not os.access(file, os.R_OK):
            raise GateError(f"{path}: transport/link/tls/{key}: {file or 'nothing'} can't be read")


def _check_rules(path: Path, config: zenoh.Config) -> None:
    """Rejects a policy that lets others than the vehicle's sockets write, except the speed by the car."""
    access = _get(config, "access_control")
    rules = {rule["id"]: rule for rule in access["rules"] or ()}
    inside = {s["id"] for s in access["subjects"] or () if s.get("link_protocols") == ["unixsock-stream"]}
    for policy in access["policies"] or ():
        if inside.issuperset(policy["subjects"]):
            continue
        for subject in access["subjects"]:
            if subject["id"] in policy["subjects"] and not subject.get("cert_common_names"):
                raise GateError(f"{path}: access_control: subject {subject['id']!r} names no certificate")
        named = [s.get("cert_common_names") for s in access["subjects"] if s["id"] in policy["subjects"]]
        by_car = all(names == [_CAR_NAME] for names in named)
        for rule in (rules[name] for name in policy["rules"] if name in rules):
            writes = _WRITING.intersection(rule["messages"])
            if by_car and writes == {"put"} and all(map(_is_cars, rule["key_exprs"])):
                continue
            if rule["permission"] == "allow" and writes and "ingress" in (rule.get("flows") or ("ingress",)):
                raise GateError(f"{path}: access_control: rule {rule['id']!r} allows {', '.join(sorted(writes))}")


def _is_cars(key_expr: str) -> bool:
    return any(key.includes(zenoh.KeyExpr(key_expr)) for key in _CAR_KEYS)


def run(path: Path, vehicle: str, runtime_dir: Path | None) -> None:
    """Runs the gate until SIGTERM or SIGINT. Raises GateError."""
    signals.block()
    config = gate_config(path, vehicle, runtime_dir)
    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn")  # log refused connections; RUST_LOG overrides it
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise GateError(f"{path}: the gate can't be opened: {error}") from error
    with session:
        listen = ", ".join(json.loads(config.get_json("listen/endpoints")))
        serve(
            f"the gate of vehicle {vehicle!r} is open: {listen}",
            lambda: f"{len(session.info.peers_zid())} nodes of the vehicle connected, open at {listen}",
        )


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the gate's process."""
    parser = argparse.ArgumentParser(
        prog="birdslam.runtime.gate", description="Read-only access for planners on other machines."
    )
    parser.add_argument("config", type=Path, metavar="CONFIG.toml", help="configuration of the vehicle")
    parser.add_argument("gate", type=Path, metavar="GATE.json5", help="zenoh settings: addresses, certificates, access")
    parser.add_argument("--runtime-dir", type=Path, metavar="DIR", help="runtime.runtime_dir of the run")
    options = parser.parse_args(arguments)
    try:
        configuration = load(options.config)
        run(options.gate, configuration.vehicle, options.runtime_dir or configuration.runtime_dir)
    except ConfigurationError as error:
        print(f"birdslam-gate: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR_STATUS
    return 0


if __name__ == "__main__":
    sys.exit(main())
