"""Transports between processes, ours and plain zenoh; each sends a time-stamped array.

    python -m birdslam.perf.latency.carriers listen|send CARRIER PLACE BYTES RATE_HZ MESSAGES

The latency is the time from before the first byte is written until the receiver has a numpy array of all bytes.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import zenoh

from birdslam.runtime.transport.bus import Bus, BusClosed, Message
from birdslam.runtime.transport.ring import FrameReader, FrameRing
from birdslam.runtime.wire import Stage, Trace
from birdslam.types import FrameRef, MapUpdate

_STAMP = struct.Struct("<qq")  # time sent (CLOCK_MONOTONIC ns), sequence number
_VEHICLE = "perf"
_EMPTY_BYTES, _POINT_BYTES = 40, 19  # of a MapUpdate as MessagePack
_MATCH_S = 10.0
_LATE_S = 0.5

Arrived = Callable[[int, int], None]  # (sent_ns, number)


class Listener(Protocol):
    def close(self) -> None: ...


class Sender(Protocol):
    def send(self, number: int) -> None: ...

    def close(self) -> None: ...


# --- ours ---


def _shape(size: int) -> tuple[int, int, int]:
    """(height, width, channels) of an image of this many bytes, a real camera's if possible."""
    return (size // (3 * 1242), 1242, 3) if size > 1_000_000 else (size // 100, 100, 1)


class _RingListener:
    """Pixels in shared memory, a FrameRef over zenoh, as capture and perceive do (runtime/transport)."""

    def __init__(self, place: Path, size: int, arrived: Arrived) -> None:
        self._bus = Bus(_VEHICLE, "supervisor", hub=True, runtime_dir=place)
        self._frames, self._ring = self._bus.subscriber("frame"), FrameReader(place / "ring")
        self._arrived = arrived
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while (message := _next(self._frames.recv)) is not None:
            if self._ring.read(message.record) is not None:
                self._arrived(message.record.t_capture_ns, message.record.frame_id)

    def close(self) -> None:
        self._bus.close()


class _RingSender:
    def __init__(self, place: Path, size: int) -> None:
        self._shape = _shape(size)
        height_px, width_px, channels = self._shape
        shape = self._shape if channels == 3 else self._shape[:2]
        self._image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
        self._ring = FrameRing(place / "ring", height_px, width_px, channels)
        self._bus = Bus(_VEHICLE, "capture", runtime_dir=place)
        self._out = self._bus.publisher("frame")
        _require(self._out.wait_matched(_MATCH_S))

    def send(self, number: int) -> None:
        now_ns = time.monotonic_ns()
        slot, sequence = self._ring.write(self._image)
        height_px, width_px, channels = self._shape
        self._out.put(
            FrameRef(
                frame_id=number,
                t_source_ns=now_ns,
                t_capture_ns=now_ns,
                t_utc_ns=0,
                slot=slot,
                sequence=sequence,
                ring_epoch=self._ring.epoch,
                width_px=width_px,
                height_px=height_px,
                channels=channels,
            )
        )

    def close(self) -> None:
        self._bus.close()
        self._ring.close()


class _BusListener:
    """A typed record over the bus, validated at both ends, as for all small messages."""

    def __init__(self, place: Path, size: int, arrived: Arrived) -> None:
        self._bus = Bus(_VEHICLE, "supervisor", hub=True, runtime_dir=place)
        self._maps, self._arrived = self._bus.subscriber("map"), arrived
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while (message := _next(self._maps.recv)) is not None:
            self._arrived(message.trace.stages[0].received_ns, message.record.frame_id)

    def close(self) -> None:
        self._bus.close()


class _BusSender:
    def __init__(self, place: Path, size: int) -> None:
        self._points = tuple((k / 7.0, k / 3.0) for k in range(1, (size - _EMPTY_BYTES) // _POINT_BYTES))
        self._bus = Bus(_VEHICLE, "optimize", runtime_dir=place)
        self._out = self._bus.publisher("map")
        _require(self._out.wait_matched(_MATCH_S))

    def send(self, number: int) -> None:
        now_ns = time.monotonic_ns()
        record = MapUpdate(epoch=0, frame_id=number, lanes_m=self._points)
        self._out.put(record, Trace((Stage("optimize", now_ns, now_ns),)))

    def close(self) -> None:
        self._bus.close()


def _next(receive: Callable[[], Message | None]) -> Message | None:
    try:
        return receive()
    except BusClosed:
        return None


def _require(ready: bool) -> None:
    if not ready:
        raise TimeoutError(f"no listener within {_MATCH_S:g} s")


# --- peers ---


class _ZenohListener:
    """zenoh over a unix socket."""

    def __init__(self, place: Path, size: int, arrived: Arrived) -> None:
        self._session = zenoh.open(_zenoh_config("listen", place))

        def receive(sample: zenoh.Sample) -> None:
            data = np.frombuffer(sample.payload.to_bytes(), dtype=np.uint8)
            arrived(*_STAMP.unpack_from(data.data))

        self._subscriber = self._session.declare_subscriber("perf/bytes", receive)

    def close(self) -> None:
        self._session.close()


class _ZenohSender:
    def __init__(self, place: Path, size: int) -> None:
        self._data = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)
        self._session = zenoh.open(_zenoh_config("connect", place))
        self._out = self._session.declare_publisher(
            "perf/bytes",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        matched = threading.Event()
        listener = self._out.declare_matching_listener(lambda status: matched.set() if status.matching else None)
        at_first: Any = self._out.matching_status
        _require(at_first.matching or matched.wait(_MATCH_S))
        listener.undeclare()

    def send(self, number: int) -> None:
        _STAMP.pack_into(self._data.data, 0, time.monotonic_ns(), number)
        self._out.put(self._data.tobytes())

    def close(self) -> None:
        self._session.close()


def _zenoh_config(role: str, place: Path) -> zenoh.Config:
    settings = {
        "mode": "peer",
        f"{role}/endpoints": [f"unixsock-stream/{place / 'zenoh.sock'}"],
        "scouting/multicast/enabled": False,
        "transport/link/protocols": ["unixsock-stream"],
        "transport/shared_memory/enabled": False,
    }
    if role == "connect":
        settings["listen/endpoints"] = []
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


CARRIERS: dict[str, tuple[Callable[..., Listener], Callable[..., Sender]]] = {
    "ring": (_RingListener, _RingSender),
    "bus": (_BusListener, _BusSender),
    "zenoh": (_ZenohListener, _ZenohSender),
}


def _listen(carrier: str, place: Path, size: int, rate_hz: float, messages: int) -> dict[str, Any]:
    arrivals: list[tuple[int, float]] = []
    last = threading.Event()

    def arrived(sent_ns: int, number: int) -> None:
        arrivals.append((number, (time.monotonic_ns() - sent_ns) / 1e6))
        if number == messages - 1:
            last.set()

    listener = CARRIERS[carrier][0](place, size, arrived)
    print("listening", flush=True)
    sys.stdin.readline()  # start of the messages
    before_s = time.process_time()
    sys.stdin.readline()  # end of the messages
    last.wait(_LATE_S)  # the last one may be dropped
    cpu_s = time.process_time() - before_s
    listener.close()
    return {"arrivals": arrivals, "cpu_s": cpu_s}


def _send(carrier: str, place: Path, size: int, rate_hz: float, messages: int) -> dict[str, Any]:
    sender = CARRIERS[carrier][1](place, size)
    print("connected", flush=True)
    sys.stdin.readline()
    before_s, begun_s = time.process_time(), time.monotonic()
    for number in range(messages):
        time.sleep(max(0.0, begun_s + number / rate_hz - time.monotonic()))
        sender.send(number)
    took_s, cpu_s = time.monotonic() - begun_s, time.process_time() - before_s
    print("sent", flush=True)
    sys.stdin.readline()  # the listener has finished
    sender.close()
    return {"took_s": took_s, "cpu_s": cpu_s}


if __name__ == "__main__":
    side, chosen, where, length, rate, count = sys.argv[1:]
    work = {"listen": _listen, "send": _send}[side]
    print(json.dumps(work(chosen, Path(where), int(length), float(rate), int(count))), flush=True)
