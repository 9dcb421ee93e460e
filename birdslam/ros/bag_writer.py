"""Writes a ROS 2 bag: a directory that appears once it is complete."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from birdslam.ros.bag import NEEDS_EXTRA, BagError
from birdslam.ros.message_types import MessageTypes
from birdslam.ros.messages import LATCHED

Storage = Literal["mcap", "sqlite3"]


class BagWriter:
    """Writes messages of ROS 2 Humble to a bag in a new directory. A context manager; raises BagError.

    The bag is written next to it and renamed at the end; after an exception nothing is left.
    """

    def __init__(self, directory: Path, storage: Storage = "mcap") -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
        except ImportError:
            raise BagError(f"{directory}: {NEEDS_EXTRA}") from None
        if directory.exists():
            raise BagError(f"{directory}: exists already; name a new directory")
        self.directory = directory
        self._partial = directory.with_name(f".{directory.name}.partial")
        self._types = MessageTypes()
        self.make = self._types.make
        self._connections: dict[str, Any] = {}
        try:
            if self._partial.exists():  # left by a killed export
                shutil.rmtree(self._partial)
            writer = Writer(self._partial / directory.name, version=8, storage_plugin=StoragePlugin[storage.upper()])
            self._writer = writer.__enter__()
        except OSError as error:
            raise BagError(f"{directory}: can't be written: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.__exit__(kind, error, trace)
            if kind is None:
                (self._partial / self.directory.name).rename(self.directory)
        except OSError as failure:
            raise BagError(f"{self.directory}: can't be written: {failure.strerror}") from None
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    def write(self, topic: str, message: Any, t_ns: int) -> None:
        """Writes a message with receive time `t_ns`."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._types.store, offered_qos_profiles=_qos(topic)
            )
        try:
            self._writer.write(self._connections[topic], max(t_ns, 0), self._types.cdr(message))
        except OSError as error:
            raise BagError(f"{self.directory}: can't be written: {error.strerror}") from None


def _qos(topic: str) -> list[Any]:
    """Latched topics are transient local, so that late subscribers get them; the rest has the default."""
    if topic not in LATCHED:
        return []
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    for_ever = QosTime(2147483647, 4294967295)
    return [
        Qos(
            QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, for_ever, for_ever,
            QosLiveliness.AUTOMATIC, for_ever, False,
        )
    ]  # fmt: skip
