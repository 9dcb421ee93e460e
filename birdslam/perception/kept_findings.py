"""The networks' findings of a drive, kept for later passes over the same images."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Image
from birdslam.perception.decoding.multitask import Findings

Run = Callable[[Image], Findings | None]
_Key = tuple[str, int, int]  # network, time, checksum of every _STEP_PX-th pixel
_STEP_PX = 16


class KeptFindings:
    """Runs a network once per image, and returns the same findings in all further passes.

    An image is identified by its time and some of its pixels. Depth maps are not kept, since they take gigabytes.
    """

    def __init__(self, encoded: Mapping[_Key, bytes] | None = None) -> None:
        """With `encoded`, those of `read`, no findings are added."""
        self._encoded = dict(encoded or {})
        self._is_complete = encoded is not None

    def run(self, name: str, t_source_ns: int, run: Run, image: Image) -> Findings | None:
        """Returns the findings of `run`, the network of this name."""
        key = name, t_source_ns, zlib.crc32(image[::_STEP_PX, ::_STEP_PX].tobytes())
        if key in self._encoded:
            return msgspec.msgpack.decode(self._encoded[key], type=Findings, dec_hook=_decode)
        found = run(image)
        if not self._is_complete and found is not None and found.depth is None:
            self._encoded[key] = msgspec.msgpack.encode(found, enc_hook=_encode)
        return found

    def write(self, path: Path) -> None:
        """Writes them to a file."""
        path.write_bytes(msgspec.msgpack.encode(list(self._encoded.items())))

    @classmethod
    def read(cls, path: Path) -> KeptFindings:
        """Reads a file of `write`."""
        return cls(dict(msgspec.msgpack.decode(path.read_bytes(), type=list[tuple[_Key, bytes]])))


def _encode(array: Any) -> tuple[str, tuple[int, ...], bytes]:
    bits = np.packbits(array) if array.dtype.kind == "b" else array
    return array.dtype.str, array.shape, zlib.compress(bits.tobytes(), 1)


def _decode(kind: type, encoded: Any) -> NDArray[Any]:
    dtype, shape, data = np.dtype(encoded[0]), encoded[1], bytearray(zlib.decompress(encoded[2]))
    if dtype.kind == "b":
        return np.unpackbits(np.frombuffer(data, np.uint8), count=int(np.prod(shape))).view(bool).reshape(shape)
    return np.frombuffer(data, dtype).reshape(shape)
