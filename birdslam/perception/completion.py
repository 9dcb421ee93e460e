"""The network that completes lane grids where the road is occluded (paper, Sec. 3.2: ENet)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from birdslam.geometry.arrays import Floats32
from birdslam.perception.manifest import ModelError

SHIPPED = Path(__file__).parent / "shipped" / "lanes.onnx"


def shipped_completion(shape: tuple[int, int]) -> GridCompletion | None:
    """The shipped network for grids of `shape`; None if it is not installed. Raises ModelError."""
    return GridCompletion(shape) if SHIPPED.is_file() else None


class GridCompletion:
    """Completes occupancy grids of road and lane boundary (2, rows, columns), 0..1.

    Raises ModelError if the file cannot be read, is not a network, or does not take grids of `shape`.
    """

    def __init__(self, shape: tuple[int, int], path: Path = SHIPPED) -> None:
        from birdslam.perception.session import plain_session  # imported late: onnxruntime takes 18 MB

        try:
            self._session = plain_session(path.read_bytes(), threads=1)
        except OSError as error:
            raise ModelError(f"{path}: the network can't be read: {error.strerror}") from error
        except Exception as error:  # onnxruntime's exceptions have no common base
            raise ModelError(f"{path}: onnxruntime can't run this network: {error}") from error
        expected = [1, 2, *shape]
        for what, tensors in (("inputs", self._session.get_inputs()), ("outputs", self._session.get_outputs())):
            if [list(tensor.shape) for tensor in tensors] != [expected]:
                raise ModelError(f"{path}: {what} have shapes {[t.shape for t in tensors]}, grids need {expected}")
        self._input = self._session.get_inputs()[0].name
        self(np.zeros((2, *shape), dtype=np.float32))  # warm-up

    def __call__(self, grids: Floats32) -> Floats32:
        """Completes grids (2, rows, columns)."""
        (out,) = self._session.run(None, {self._input: grids[None]})
        completed: Floats32 = out[0]
        return completed
