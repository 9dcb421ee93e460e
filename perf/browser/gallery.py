"""The pictures of docs/gallery.md: of the rendered drive that ships, and so of no real street.

    python -m perf gallery --output DIR [--run DIR]

`birdslam run --source demo` drives it (`--run`: it did, there); of what that leaves these are frames of the film, the
whole drive from above, and the report as Chromium shows it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.outputs.report.page import REPORT
from birdslam.perf.browser.reports import moved
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import run_birdslam
from birdslam.perf.reporting.arguments import benchmark_parser

label = "the pictures of the gallery: of the rendered drive that ships"

FILM, ABOVE = "drive.mp4", "bev.png"
FRAMES = {"street": 0.12, "traffic": 0.92}  # picture -> where in the film
WIDTH_PX = 1000
QUALITY = 82
PICTURES = (*FRAMES, "above", "report", "report-dark")
REPORT_PX = 1500  # of a report's length


def run(arguments: list[str]) -> None:
    """Writes the pictures, and prints how large they are."""
    parser = benchmark_parser("gallery", label, output="")
    parser.add_argument("--run", type=Path, metavar="DIR", help="what a run of the demo left")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="where the pictures go")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        drive = options.run or Path(folder) / "demo"
        if options.run is None:
            # Slower than it was driven: a busy machine still looks at every frame
            run_birdslam("run", "--source", "demo", "--rate", "10", "--output", str(drive))
        for name, where in FRAMES.items():
            _write(options.output / f"{name}.jpg", _frame(drive / FILM, where))
        _write(options.output / "above.jpg", _read(drive / ABOVE))
        for name, way in (("report", "light"), ("report-dark", "dark")):
            picture = Path(folder) / f"{name}.png"
            seen = moved(drive / REPORT, picture, way)
            if seen.console:
                raise PerfError(f"{drive / REPORT}: {seen.console[0]}")
            _write(options.output / f"{name}.jpg", _read(picture)[:REPORT_PX])


def _frame(film: Path, where: float) -> NDArray[np.uint8]:
    reader = cv2.VideoCapture(str(film))
    frames = []
    while True:
        there, image = reader.read()
        if not there:
            break
        frames.append(image)
    reader.release()
    if not frames:
        raise PerfError(f"{film}: no film")
    return np.asarray(frames[round(where * (len(frames) - 1))], dtype=np.uint8)


def _read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    if image is None:
        raise PerfError(f"{path}: no picture")
    return np.asarray(image, dtype=np.uint8)


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    scale = min(1.0, WIDTH_PX / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
