"""A camera with faults for every Python process whose path has this folder; for the fault suite alone (faults.py).

With FAULTY_CAMERA=DIR, cv2.VideoCapture shows DIR/frames.npy in a loop, DIR/rate_hz frames a second, and does what
DIR/fault contains: "", gone, frozen, black, torn, late, disorder, or clock_step (UTC an hour off).
"""

import os
import time
from pathlib import Path

FOLDER = os.environ.get("FAULTY_CAMERA")

if FOLDER:
    import cv2
    import numpy as np

    _folder = Path(FOLDER)
    _time_ns = time.time_ns

    def _fault() -> str:
        return (_folder / "fault").read_text().strip()

    class FaultyCapture:
        """As much of cv2.VideoCapture as a LiveCamera uses."""

        def __init__(self, address: str, *arguments: object) -> None:
            self._frames = np.load(_folder / "frames.npy", mmap_mode="r")
            self._rate_hz = float((_folder / "rate_hz").read_text())
            self._number = self._shown = 0
            self._fault = ""
            self._due_s = time.monotonic()

        def isOpened(self) -> bool:
            return _fault() != "gone"

        def get(self, what: int) -> float:
            height, width = self._frames.shape[1:]
            return {cv2.CAP_PROP_FRAME_WIDTH: width, cv2.CAP_PROP_FRAME_HEIGHT: height}.get(what, self._rate_hz)

        def set(self, what: int, value: float) -> bool:
            return True

        def grab(self) -> bool:
            fault = _fault()
            if fault == "gone":
                return False
            now_s = time.monotonic()
            self._due_s = max(self._due_s + 1.0 / self._rate_hz, now_s - 1.0 / self._rate_hz)
            time.sleep(max(0.0, self._due_s - now_s) + (0.4 if fault == "late" else 0.0))
            # unread frames are skipped: the time determines the image
            before, self._number = self._number, int(time.monotonic() * self._rate_hz)
            self._shown = before if fault == "frozen" else self._number
            if fault == "frozen":
                self._number = before
            if fault == "disorder":
                self._shown = self._number ^ 1
            self._fault = fault
            return True

        def retrieve(self) -> tuple[bool, np.ndarray | None]:
            if self._fault == "torn":
                return False, None
            image = np.array(self._frames[self._shown % len(self._frames)])
            return True, np.zeros_like(image) if self._fault == "black" else image

        def release(self) -> None:
            self._shown = 0

    vars(cv2)["VideoCapture"] = FaultyCapture
    vars(time)["time_ns"] = lambda: _time_ns() + (3_600_000_000_000 if _fault() == "clock_step" else 0)
