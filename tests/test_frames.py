"""The ring of frames: written frames are read back; torn, overwritten or foreign data is never returned as a frame."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.runtime.transport.ring import FrameError, FrameReader, FrameRing
from birdslam.types import FrameRef
from tests.records import new_frame_ref

ROOT = Path(__file__).parent.parent
HEIGHT_PX, WIDTH_PX = 37, 53


def ref_of(image: np.ndarray, place: tuple[int, int], epoch: int) -> FrameRef:
    height_px, width_px = image.shape[:2]
    channels = image.shape[2] if image.ndim == 3 else 1
    return new_frame_ref(
        slot=place[0], sequence=place[1], ring_epoch=epoch, width_px=width_px, height_px=height_px, channels=channels
    )


def some_image(seed: int, height_px: int = HEIGHT_PX, width_px: int = WIDTH_PX, channels: int = 3) -> np.ndarray:
    shape = (height_px, width_px, channels) if channels == 3 else (height_px, width_px)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[FrameRing]:
    with FrameRing(tmp_path / "ring", HEIGHT_PX, WIDTH_PX, slots=4) as ring:
        yield ring


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[FrameReader]:
    with FrameReader(tmp_path / "ring") as reader:
        yield reader


def test_every_frame_that_fits_is_read_back(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("frames") / "ring"
    with FrameRing(path, HEIGHT_PX, WIDTH_PX, slots=2) as ring, FrameReader(path) as reader:

        @given(
            st.integers(1, HEIGHT_PX), st.integers(1, WIDTH_PX), st.sampled_from((1, 3)), st.integers(0), st.booleans()
        )
        def comes_back(height_px: int, width_px: int, channels: int, seed: int, strided: bool) -> None:
            image = some_image(seed, height_px, width_px, channels)
            if strided:
                image = image[::-1, ::-1]
            got = reader.read(ref_of(image, ring.write(image), ring.epoch))
            np.testing.assert_array_equal(got, image)

        comes_back()


def test_a_slow_reader_finds_the_last_frames_only(ring: FrameRing, reader: FrameReader) -> None:
    images = [some_image(seed) for seed in range(11)]
    refs = [ref_of(image, ring.write(image), ring.epoch) for image in images]
    got = [reader.read(ref) for ref in refs]
    assert [image is not None for image in got] == [False] * 7 + [True] * 4
    for image, written in zip(got[7:], images[7:], strict=True):
        np.testing.assert_array_equal(image, written)


def test_reads_into_a_buffer(ring: FrameRing, reader: FrameReader) -> None:
    image = some_image(1)
    ref = ref_of(image, ring.write(image), ring.epoch)
    buffer = np.zeros_like(image)
    assert reader.read(ref, buffer) is buffer
    np.testing.assert_array_equal(buffer, image)
    for wrong in (np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8), np.zeros_like(image, dtype=np.float32), buffer[:, ::-1]):
        with pytest.raises(FrameError, match="buffer"):
            reader.read(ref, wrong)


def test_a_frame_is_a_copy(ring: FrameRing, reader: FrameReader) -> None:
    image = some_image(1)
    got = reader.read(ref_of(image, ring.write(image), ring.epoch))
    for seed in range(ring.slots):
        ring.write(some_image(seed + 2))
    np.testing.assert_array_equal(got, image)


def test_changed_byte_is_detected(ring: FrameRing, reader: FrameReader) -> None:
    image = some_image(3)
    ref = ref_of(image, ring.write(image), ring.epoch)
    assert reader.read(ref) is not None
    data = bytearray(ring.path.read_bytes())
    data[data.index(image.tobytes()) + 1000] ^= 0x10
    with ring.path.open("r+b") as file:
        file.write(data)
    assert reader.read(ref) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"slot": -1},
        {"slot": 4},
        {"slot": 2**40},
        {"sequence": 1},
        {"sequence": 4},
        {"ring_epoch": 5},
        {"width_px": WIDTH_PX - 1},
        {"width_px": HEIGHT_PX, "height_px": WIDTH_PX},
        {"width_px": 0},
        {"width_px": -WIDTH_PX, "height_px": -HEIGHT_PX},
        {"height_px": 2**60},
        {"channels": 1},
        {"channels": 2},
    ],
)
def test_wrong_reference_gives_no_frame(ring: FrameRing, reader: FrameReader, changes: dict[str, int]) -> None:
    image = some_image(1)
    right = ref_of(image, ring.write(image), ring.epoch)
    assert reader.read(right) is not None
    assert reader.read(msgspec.structs.replace(right, **changes)) is None


def test_a_new_ring_replaces_the_old_and_readers_follow(tmp_path: Path, reader: FrameReader) -> None:
    image = some_image(1)
    assert reader.read(ref_of(image, (0, 2), 1)) is None  # there is no ring yet
    old = FrameRing(reader.path, HEIGHT_PX, WIDTH_PX)
    old_ref = ref_of(image, old.write(image), old.epoch)
    assert reader.read(old_ref) is not None
    new = FrameRing(reader.path, 2 * HEIGHT_PX, WIDTH_PX, slots=3)
    assert new.epoch != old.epoch
    larger = some_image(2, height_px=2 * HEIGHT_PX)
    np.testing.assert_array_equal(reader.read(ref_of(larger, new.write(larger), new.epoch)), larger)
    assert reader.read(old_ref) is None
    old.close()  # it must not take the new one away
    assert reader.path.exists()
    new.close()
    new.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"BIRD", b"x" * 64, b"BIRDRING" + bytes(56), b"x" * 100_000])
def test_a_foreign_file_is_named(tmp_path: Path, reader: FrameReader, content: bytes) -> None:
    reader.path.write_bytes(content)
    with pytest.raises(FrameError, match=str(reader.path)):
        reader.read(ref_of(some_image(1), (0, 2), 1))


def test_truncated_ring_is_named(ring: FrameRing, reader: FrameReader) -> None:
    cut = ring.path.read_bytes()[:-64]
    ring.path.unlink()  # not truncated in place: the writer still has it mapped
    ring.path.write_bytes(cut)
    with pytest.raises(FrameError, match="does not match"):
        reader.read(ref_of(some_image(1), (0, 2), ring.epoch))


def test_invalid_frames_are_refused(tmp_path: Path, ring: FrameRing) -> None:
    for image in (
        some_image(1, height_px=HEIGHT_PX + 1),
        np.zeros((HEIGHT_PX, WIDTH_PX), np.float32),
        np.zeros((HEIGHT_PX, WIDTH_PX, 2), np.uint8),
        np.zeros((HEIGHT_PX, 0), np.uint8),
        np.zeros(HEIGHT_PX, np.uint8),
    ):
        with pytest.raises(FrameError):
            ring.write(image)
    for sizes in ((0, 5, 3), (5, 5, 2), (5, 1 << 20, 3)):
        with pytest.raises(FrameError, match="no frame"):
            FrameRing(tmp_path / "other", *sizes)
    with pytest.raises(FrameError, match="slots"):
        FrameRing(tmp_path / "other", 5, 5, slots=1)


def test_missing_space_is_reported_before_the_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_fd: int, _offset: int, _length: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(OSError, match="no room for a ring") as caught:
        FrameRing(tmp_path / "ring", HEIGHT_PX, WIDTH_PX)
    assert caught.value.filename == str(tmp_path / "ring")
    assert list(tmp_path.iterdir()) == []


# A second process writes frames of one value each, the n-th of n % 251, and counts them in a file that it shares. It is
# killed: at any time by its parent, or by itself in the middle of copying a frame.
WRITER = """
import os, signal, sys
from pathlib import Path
import numpy as np
from birdslam.runtime.transport import ring as frames

path, die_at = Path(sys.argv[1]), int(sys.argv[2])
ring = frames.FrameRing(path, 96, 128, slots=2)
count = np.memmap(path.with_name("count"), np.int64, "w+", shape=(1,))
print(ring.epoch, flush=True)
copy = np.copyto

def copy_half_and_die(target, image):
    copy(target[: len(target) // 2], image[: len(image) // 2])
    os.kill(os.getpid(), signal.SIGKILL)

while True:
    n = int(count[0])
    if n == die_at:
        frames.np.copyto = copy_half_and_die
    ring.write(np.full((96, 128, 3), n % 251, np.uint8))
    count[0] = n + 1
"""


def start_writer(path: Path, die_at: int = -1) -> tuple[subprocess.Popen[str], int, np.ndarray]:
    command = [sys.executable, "-c", WRITER, str(path), str(die_at)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    epoch = int(process.stdout.readline())
    return process, epoch, np.memmap(path.with_name("count"), np.int64, "r", shape=(1,))


def numbered(n: int, epoch: int) -> FrameRef:
    """The reference that a writer of two slots gives to its n-th frame."""
    return ref_of(np.empty((96, 128, 3), np.uint8), (n % 2, 2 * (n // 2 + 1)), epoch)


@pytest.mark.processes
def test_killed_writer_leaves_no_partial_frame(tmp_path: Path, reader: FrameReader) -> None:
    process, epoch, _ = start_writer(reader.path, die_at=5)
    with process:
        assert process.wait(timeout=120) == -signal.SIGKILL
        got = [reader.read(numbered(n, epoch)) for n in range(7)]
    # 3 lay in the slot that was being overwritten by 5
    assert [image is not None for image in got] == [False, False, False, False, True, False, False]
    assert (got[4] == 4).all()
    with FrameRing(reader.path, HEIGHT_PX, WIDTH_PX) as ring:
        image = some_image(1)
        np.testing.assert_array_equal(reader.read(ref_of(image, ring.write(image), ring.epoch)), image)
    assert [path.name for path in tmp_path.iterdir()] == ["count"]


@pytest.mark.processes
def test_two_processes_under_stress_never_read_a_wrong_frame(reader: FrameReader) -> None:
    whole = missed = 0
    buffer = np.empty((96, 128, 3), np.uint8)
    for turn in range(4):
        process, epoch, count = start_writer(reader.path)
        try:
            end_s = time.monotonic() + 1.0
            while time.monotonic() < end_s:
                # Of two slots the newer is whole for a moment, and the older is about to be overwritten.
                for n in range(max(int(count[0]) - 2, 0), int(count[0]) + 1):
                    if reader.read(numbered(n, epoch), buffer) is None:
                        missed += 1
                    else:
                        assert (buffer == n % 251).all(), f"frame {n} of writer {turn} is wrong"
                        whole += 1
        finally:
            process.kill()
            process.communicate(timeout=120)
        for n in range(max(int(count[0]) - 4, 0), int(count[0]) + 2):
            image = reader.read(numbered(n, epoch))
            assert image is None or (image == n % 251).all()
    assert whole > 100
    assert missed > 100
