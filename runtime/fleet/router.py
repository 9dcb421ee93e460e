"""The router of a fleet: `birdslam router CONFIG.toml`, with the permissions of the table [router].

A zenoh session in router mode. A vehicle's certificate, with the common name "vehicle NAME", may write the keys of NAME
and answer queries of them; a listener's may read and query all; everything else is denied. Messages of a vehicle over
the rate limit are dropped on arrival.
"""

from __future__ import annotations

from typing import Any

import zenoh

from birdslam.runtime.configuration import ConfigurationError, RouterConfig
from birdslam.runtime.fleet.link import BUFFERS, check, settings_of, zenoh_config
from birdslam.runtime.process import signals
from birdslam.runtime.process.notify import serve
from birdslam.runtime.topology import QUERIES, VERSION, every_key

_ACCEPT_MS = 2_000  # timeout of the handshake
PUBLISHED = ("estimate", "health/*")  # by a vehicle; no images, no measurements
QUERYABLE = (*PUBLISHED, *QUERIES)  # answered by a vehicle
ALIVE = "alive/*"


def router_config(config: RouterConfig) -> zenoh.Config:
    """Returns the configuration of the router's session. Raises ConfigurationError with the key."""
    check("router", config, "listen")
    if not config.vehicles:
        raise ConfigurationError("router.vehicles: is empty; name the vehicles that may publish")
    settings = settings_of("router") | {
        "listen/endpoints": [config.listen],
        "transport/unicast/accept_timeout": _ACCEPT_MS,
        "transport/link/tls": {
            "enable_mtls": True,
            "root_ca_certificate": config.ca,
            "listen_certificate": config.certificate,
            "listen_private_key": config.key,
            **BUFFERS,
        },
        "access_control": access_control(config.vehicles, config.listeners),
        "downsampling": [
            {
                "id": "no flood",
                "flows": ["ingress"],
                "messages": ["put", "delete"],
                "rules": [{"key_expr": every_key(topic), "freq": config.messages_hz} for topic in PUBLISHED],
            }
        ],
    }
    return zenoh_config(settings)


def access_control(vehicles: tuple[str, ...], listeners: tuple[str, ...]) -> dict[str, Any]:
    """Returns zenoh's access control; the default is to deny."""
    rules = [
        _rule("vehicles are queried", "egress", ["declare_subscriber", "query"], map(every_key, QUERYABLE)),
        _rule(
            "vehicles are watched", "egress", ["declare_liveliness_subscriber", "liveliness_query"], [every_key(ALIVE)]
        ),
    ]
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for vehicle in vehicles:
        base = f"birdslam/{vehicle}/{VERSION}"
        rules += [
            _rule(f"{vehicle} publishes", "ingress", ["put"], [f"{base}/{topic}" for topic in PUBLISHED]),
            _rule(f"{vehicle} answers", "ingress", ["declare_queryable", "reply"], [f"{base}/{t}" for t in QUERYABLE]),
            _rule(f"{vehicle} is alive", "ingress", ["liveliness_token"], [f"{base}/{ALIVE}"]),
        ]
        subjects.append(_subject(f"vehicle {vehicle}", [f"vehicle {vehicle}"]))
        own = [rule["id"] for rule in rules[-3:]]
        policies.append(_policy(f"vehicle {vehicle}", [*own, "vehicles are queried", "vehicles are watched"]))
    if listeners:
        rules += [
            _rule("listeners query", "ingress", ["declare_subscriber", "query"], map(every_key, QUERYABLE)),
            _rule(
                "listeners watch liveliness",
                "ingress",
                ["declare_liveliness_subscriber", "liveliness_query"],
                [every_key(ALIVE)],
            ),
            _rule("listeners receive", "egress", ["put", "reply"], map(every_key, QUERYABLE)),
            _rule("listeners receive liveliness", "egress", ["liveliness_token"], [every_key(ALIVE)]),
        ]
        subjects.append(_subject("listeners", list(listeners)))
        policies.append(_policy("listeners", [rule["id"] for rule in rules[-4:]]))
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rule(name: str, flow: str, messages: list[str], keys: Any) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": list(keys)}


def _subject(name: str, common_names: list[str]) -> dict[str, Any]:
    return {"id": name, "link_protocols": ["tls"], "cert_common_names": common_names}


def _policy(name: str, rules: list[str]) -> dict[str, Any]:
    return {"id": name, "subjects": [name], "rules": rules}


def run(config: RouterConfig) -> None:
    """Routes until SIGTERM or SIGINT. Raises ConfigurationError."""
    settings = router_config(config)
    signals.block()
    # Log refused connections and their reasons; RUST_LOG overrides it
    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn,zenoh::net::routing::interceptor::access_control=info")
    try:
        session = zenoh.open(settings)
    except zenoh.ZError as error:
        raise ConfigurationError(f"router.listen {config.listen}: the router can't be opened: {error}") from error
    with session:
        vehicles = f"{len(config.vehicles)} vehicles"
        serve(
            f"the router is open for {vehicles}: {config.listen}",
            lambda: f"{vehicles} may publish, open at {config.listen}",
        )
