"""Variants of a film: other sizes, rates and compressions, and obstructions in front of the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec.structs import replace

from birdslam.geometry.arrays import Image
from birdslam.geometry.camera import Camera
from birdslam.world.windscreen import from_share

Timed = tuple[int, Image]  # t_source_ns, the raw image
Change = Callable[[int, Image], Image]  # (index of an image, image)

MIN_WIDTH_PX, MAX_WIDTH_PX = 320, 3840
_ENCODER = "libx264"


@dataclass(frozen=True)
class Variant:
    """The differences to the original film."""

    name: str
    size: float = 1.0
    every: int = 1  # use only each n-th image
    repeats: int = 1  # copies of each image, as in films converted to another rate
    interlaced: bool = False  # every second row is from the next image
    crf: int | None = None  # of H.264: 18 is fine, 35 coarse
    shown: Change | None = None

    def camera(self, camera: Camera) -> Camera:
        """The camera of the changed images; `camera` is that of the original film."""
        if self.size == 1.0:
            return camera
        width_px, height_px = (round(side * self.size) for side in (camera.width_px, camera.height_px))
        x, y = width_px / camera.width_px, height_px / camera.height_px
        return replace(
            camera,
            width_px=width_px,
            height_px=height_px,
            fx_px=camera.fx_px * x,
            fy_px=camera.fy_px * y,
            cx_px=(camera.cx_px + 0.5) * x - 0.5,
            cy_px=(camera.cy_px + 0.5) * y - 0.5,
        )

    def fits(self, camera: Camera) -> bool:
        """Whether the width is within the supported range."""
        return MIN_WIDTH_PX <= camera.width_px * self.size <= MAX_WIDTH_PX

    def images(self, film: Iterator[Timed], folder: Path) -> Iterator[Timed]:
        """The changed images of a film; `folder` is for encoded files."""
        yield from _encoded(
            self._repeated(self._resized(_interlaced(film) if self.interlaced else film)), self.crf, folder
        )

    def _repeated(self, film: Iterator[Timed]) -> Iterator[Timed]:
        before: Timed | None = None
        for t_ns, image in film:
            if before is not None:  # repetitions are between an image and the next
                for repeat in range(1, self.repeats):
                    yield before[0] + repeat * (t_ns - before[0]) // self.repeats, before[1]
            before = t_ns, image
            yield before

    def _resized(self, film: Iterator[Timed]) -> Iterator[Timed]:
        for k, (t_ns, image) in enumerate(film):
            if k % self.every:
                continue
            if self.shown is not None:
                image = self.shown(k, image)
            if self.size != 1.0:
                size = round(image.shape[1] * self.size), round(image.shape[0] * self.size)
                how = cv2.INTER_AREA if self.size < 1.0 else cv2.INTER_CUBIC
                image = np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)
            yield t_ns, image


PARTS = ("starts", "sizes", "noise", "compression", "view")
_SIZES, _EVERY = (1.0, 0.5, 0.75, 2.0), (1, 2, 3)
_NOISE_GREY, _DRAWS = 1.5, 5  # 1-sigma of invisible noise; number of draws
_USUAL_CRF = 23
_DIRT_SEED = 1


def variants(camera: Camera, part: str) -> list[Variant]:
    """The variants of a part of PARTS for a film of this camera, the unchanged one first."""
    every = {
        "starts": [_other(1.0, 1), _other(0.5, 1), _other(1.0, 2), _other(1.0, 3)],
        "sizes": [_other(size, n) for size in _SIZES for n in _EVERY],
        "noise": [Variant("unchanged"), *(Variant(f"noise, draw {n}", shown=_noise(n)) for n in range(1, _DRAWS + 1))],
        "compression": [Variant("unchanged"), *(Variant(f"H.264, crf {crf}", crf=crf) for crf in (18, 23, 28, 35))],
        "view": [
            Variant("unchanged"),
            Variant("each image twice", repeats=2),
            Variant("each image twice, H.264", repeats=2, crf=_USUAL_CRF),
            Variant("interlaced, every 2 images", every=2, interlaced=True),
            Variant("caption", shown=_caption),
            Variant("bonnet", shown=_bonnet),
            Variant("dirt", shown=_dirt()),
            Variant("flicker", shown=_flicker),
        ],
    }[part]
    return [variant for variant in every if variant.fits(camera)]


def _other(size: float, every: int) -> Variant:
    parts = [f"{size:g} of the size"] * (size != 1.0) + [f"every {every} images"] * (every != 1)
    return Variant(", ".join(parts) or "unchanged", size=size, every=every)


def _interlaced(film: Iterator[Timed]) -> Iterator[Timed]:
    """Interlaced images: rows of two times in each; drops the last image."""
    first: Timed | None = None
    for t_ns, image in film:
        if first is not None:
            both = first[1].copy()
            both[1::2] = image[1::2]
            yield first[0], both
        first = t_ns, image


def _encoded(film: Iterator[Timed], crf: int | None, folder: Path) -> Iterator[Timed]:
    """The film encoded and decoded, with its own times."""
    if crf is None:
        yield from film
        return
    import av  # imported late: only needed here

    path = folder / "encoded.mp4"
    times_ns: list[tuple[int, tuple[int, int]]] = []
    with av.open(str(path), "w") as out:
        stream: Any = None
        for t_ns, image in film:
            if stream is None:
                stream = out.add_stream(_ENCODER, rate=Fraction(30), options={"crf": str(crf), "preset": "veryfast"})
                stream.height, stream.width = (side - side % 2 for side in image.shape[:2])
                stream.pix_fmt = "yuv420p"
            even = np.ascontiguousarray(image[: stream.height, : stream.width])
            out.mux(stream.encode(av.VideoFrame.from_ndarray(even, "gray" if even.ndim == 2 else "bgr24")))
            times_ns.append((t_ns, (image.shape[0], image.shape[1])))
        if stream is not None:
            out.mux(stream.encode(None))
    with av.open(str(path)) as encoded:
        for (t_ns, (rows, columns)), frame in zip(times_ns, encoded.decode(video=0), strict=True):
            image = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
            more = ((0, rows - image.shape[0]), (0, columns - image.shape[1]), (0, 0))
            yield t_ns, np.pad(image, more, mode="edge")


def _noise(draw: int) -> Change:
    """Invisible noise; the resulting differences are the significance threshold of all others."""

    def noisy(index: int, image: Image) -> Image:
        added = np.random.default_rng((draw, index)).normal(0.0, _NOISE_GREY, image.shape)
        return np.clip(np.rint(image + added), 0, 255).astype(np.uint8)

    return noisy


# --- obstructions ---


def _caption(index: int, image: Image) -> Image:
    """Position and time along the lower edge, as dashboard cameras write them."""
    out = image.copy()
    rows, columns = out.shape[:2]
    text = f"CAMERA 2020-01-01 12:{index // 1800:02d}:{index // 30 % 60:02d}  51.0000 -114.0000"
    at = round(0.01 * columns), round(0.985 * rows)
    cv2.putText(out, text, at, cv2.FONT_HERSHEY_PLAIN, columns / 900.0, (235, 235, 235), max(1, columns // 700))
    return out


def _dirt() -> Change:
    """Fixed spots on the windscreen."""
    edit = from_share("dirt", _DIRT_SEED, 0.0)
    return lambda index, image: edit(index, 1, image)


def _bonnet(_: int, image: Image) -> Image:
    """A dark bonnet in the lowest eighth, with an edge that reflects the sky."""
    out = image.copy()
    rows, columns = out.shape[:2]
    centre, axes = (columns // 2, round(1.25 * rows)), (round(0.7 * columns), round(0.38 * rows))
    cv2.ellipse(out, centre, axes, 0.0, 180.0, 360.0, (40, 40, 42), cv2.FILLED)
    cv2.ellipse(out, centre, axes, 0.0, 180.0, 360.0, (130, 130, 130), max(1, rows // 200))
    return out


def _flicker(index: int, image: Image) -> Image:
    """Brightness flicker, as from 100 Hz lamps at 30 Hz or an unstable exposure."""
    gain = 1.0 + 0.12 * np.sin(2.0 * np.pi * index / 3.0)
    return np.asarray(np.clip(image * gain, 0, 255), np.uint8)
