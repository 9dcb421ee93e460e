"""A ROS 2 node on a zenoh session at the router of rmw_zenoh.

The session is a client and does not listen. ZENOH_SESSION_CONFIG_URI may name a file with its certificates and access
rules, as for every node of rmw_zenoh.
"""

from __future__ import annotations

import itertools
import json
import os
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from birdslam.ros.message_types import MessageTypes
from birdslam.ros.rmw_zenoh import (
    MAX_DOMAIN,
    NO_HASH,
    Node,
    Qos,
    attachment,
    check_namespace,
    check_topic,
    gid,
    topic_key,
)
from birdslam.runtime.configuration import ConfigurationError, RosConfig
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.transport.session import close_session, open_session

SESSION_FILE = "ZENOH_SESSION_CONFIG_URI"
DOMAIN = "ROS_DOMAIN_ID"
ROUTER_S = 2.0  # timeout of one attempt to connect
_MAX_BYTES = 1 << 26  # of a message: a colour image of 5000x4000 px; zenoh's default is 1 GiB
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
_HEARTBEAT_S = 0.5  # of latched topics, as in rmw_zenoh
_CDR = zenoh.Encoding("application/cdr")


def domain_of(config: RosConfig) -> int:
    """Returns the configured domain, else that of the environment variable."""
    if config.domain is not None:
        return config.domain
    text = os.environ.get(DOMAIN, "0")
    if not text.isdecimal() or int(text) > MAX_DOMAIN:
        raise ConfigurationError(f"{DOMAIN}={text!r}: needs a number from 0 to {MAX_DOMAIN}")
    return int(text)


class NoRouter(RuntimeError):
    """The router is not reachable."""


def session_config(router: str, timeout_s: float) -> zenoh.Config:
    """Returns zenoh's configuration: wait `timeout_s` for the router, reconnect without limit after a loss.

    Raises ConfigurationError for an invalid session file.
    """
    file = os.environ.get(SESSION_FILE)
    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "client",
            "connect/endpoints": [router],
            "connect/timeout_ms": round(1e3 * timeout_s),
            "connect/exit_on_failure": True,
            "connect/retry": _RETRY,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/link/rx/max_message_size": _MAX_BYTES,
            "transport/shared_memory/enabled": False,
            "adminspace/enabled": False,
            "timestamping/enabled": True,  # needed for latched topics
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        where = f"{SESSION_FILE}={file}" if file else f"ros.router {router!r}"
        raise ConfigurationError(f"{where}: {error}") from error
    return config


class RosPublisher:
    """A publisher of one topic. `publish` does not wait: messages are dropped on congestion, as in rmw_zenoh."""

    def __init__(self, session: zenoh.Session, key: str, token: str, qos: Qos, read: Callable[[Any], bytes]) -> None:
        self._cdr, self._gid, self._numbers = read, gid(token), itertools.count(1)
        reliability = zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
        self._publisher: Any
        if qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                encoding=_CDR,
                congestion_control=zenoh.CongestionControl.DROP,
                reliability=reliability,
                cache=zenoh.ext.CacheConfig(qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(
                key, encoding=_CDR, congestion_control=zenoh.CongestionControl.DROP, reliability=reliability
            )
        self._token = session.liveliness().declare_token(token)

    def publish(self, message: Any) -> None:
        """Publishes one message."""
        header = attachment(next(self._numbers), time.time_ns(), self._gid)
        self._publisher.put(self._cdr(message), attachment=header)


class RosNode(Closing):
    """A node with its publishers and subscriptions. A context manager.

    Raises ConfigurationError for an invalid name or file, NoRouter without a connection in time.
    """

    def __init__(self, config: RosConfig, name: str, timeout_s: float = ROUTER_S) -> None:
        self.types = MessageTypes()
        self.domain = domain_of(config)
        try:
            namespace = check_namespace(config.namespace)
            check_topic(f"/{name}")
        except ValueError as error:
            raise ConfigurationError(f"ros.namespace: {error}") from None
        self._hashed = config.release != "humble"
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()  # of the tokens: subscriptions come from zenoh's threads
        settings = session_config(config.router, timeout_s)
        try:
            self.session = open_session(settings)
        except zenoh.ZError as error:
            raise NoRouter(
                f"ros.router {config.router}: the router is not reachable: no connection within {timeout_s:g} s"
            ) from error
        self.node = Node(self.domain, str(self.session.info.zid()), namespace, name)
        self._tokens = [self.session.liveliness().declare_token(self.node.token())]
        self._subscribers: list[Any] = []

    @property
    def connected(self) -> bool:
        """Whether the router is connected."""
        return bool(self.session.info.routers_zid())

    def type_hash(self, type_name: str) -> str:
        """Returns the type hash of the configured ROS release."""
        return self.types.type_hash(type_name) if self._hashed else NO_HASH

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RosPublisher:
        """Returns a publisher of a full topic name."""
        hashed = self.type_hash(type_name)
        token = self.node.publisher_token(next(self._numbers), topic, type_name, hashed, qos)
        key = topic_key(self.domain, topic, type_name, hashed)
        return RosPublisher(self.session, key, token, qos, self.types.cdr)

    def subscribe(self, key: str, receive: Callable[[zenoh.Sample], object], late: bool = False) -> None:
        """Calls `receive` for each message on zenoh's thread; with `late` also for latched ones (/tf_static)."""
        callback = zenoh.handlers.Callback(receive, indirect=False)
        if late:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            self._subscribers.append(
                zenoh.ext.declare_advanced_subscriber(self.session, key, callback, history=history)
            )
        else:
            self._subscribers.append(self.session.declare_subscriber(key, callback))

    def watch(self, key: str, came: Callable[[str], object]) -> None:
        """Calls `came` for each present or new liveliness token, on zenoh's thread."""

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                came(str(sample.key_expr))

        callback = zenoh.handlers.Callback(changed, indirect=False)
        self._subscribers.append(self.session.liveliness().declare_subscriber(key, callback, history=True))

    def declare_subscription(self, topic: str, type_name: str, type_hash: str, qos: Qos) -> None:
        """Declares a subscription to the publishers of a topic; some send only to subscribers."""
        with self._lock:
            token = self.node.subscription_token(next(self._numbers), topic, type_name, type_hash, qos)
            self._tokens.append(self.session.liveliness().declare_token(token))

    def close(self) -> None:
        """Closes the session; a second call does nothing."""
        close_session(self.session)
