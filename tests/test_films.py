"""Films as cameras and phones write them: uneven times, turned pictures, several files, and what is no film.

The films are written by PyAV, which is a dev dependency alone.
"""

from __future__ import annotations

import functools
import struct
import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.runtime.calibration.given import METADATA_SIGMA_REL, Given, focal_length_of
from birdslam.runtime.cli.main import main
from birdslam.sources.films.interlaced import is_undecoded, may_be_interlaced
from birdslam.sources.films.video import VideoRecording
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, RecordedFrame
from birdslam.sources.schemes import RECORDED, uri_of

av = pytest.importorskip("av", reason="films are written by PyAV (pip install av)")

WIDTH, HEIGHT = 96, 64
CAMERA = Camera(WIDTH, HEIGHT, 80.0, 80.0, 48.0, 32.0, 1.4)
UPRIGHT = Camera(HEIGHT, WIDTH, 80.0, 80.0, 32.0, 48.0, 1.4)
# Of the display matrix in a track's header: a point of the file's picture to one of the screen
TURNED = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
FOCAL_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def film(
    path: Path,
    times_ms: Sequence[int],
    codec: str = "libx264",
    audio: bool = False,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    metadata: dict[str, str] | None = None,
) -> Path:
    """One frame at each time; its upper left quarter is bright, the rest is darker from frame to frame."""
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"} if metadata else {}) as container:
        container.metadata.update(metadata or {})
        options = {"x265-params": "log-level=none"} if codec == "libx265" else {"threads": "1"}
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p" if size[0] % 2 == 0 else "yuv444p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        sound = container.add_stream("aac", rate=44100) if audio else None
        for number, t_ms in enumerate(times_ms):
            picture = np.full((size[1], size[0], 3), 100 - number % 20, np.uint8)
            picture[: size[1] // 2, : size[0] // 2] = 220
            frame = av.VideoFrame.from_ndarray(picture, "bgr24")
            frame.pts, frame.time_base = t_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        if sound is not None:
            silence = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
            silence.rate, silence.pts = 44100, 0
            container.mux([*sound.encode(silence), *sound.encode(None)])
        container.mux(stream.encode(None))
    return path


def turned(path: Path, degrees: int) -> Path:
    """The film with the flag of a phone that was held otherwise."""
    data = path.read_bytes()
    at = data.index(b"tkhd") + 4 + 40  # version 0: flags, times, number, length, layer, volume; then the matrix
    a, b, c, d = (65536 * n for n in TURNED[degrees])
    path.write_bytes(data[:at] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + data[at + 36 :])
    return path


def frames(path: Path, camera: Camera = CAMERA, stride: int = 1) -> list[RecordedFrame]:
    return list(open_recording(f"video:{path}", camera, stride).frames())


def times_ms(seen: Sequence[RecordedFrame]) -> list[int]:
    return [round(frame.t_source_ns / 1e6) for frame in seen]


STEPS = st.lists(st.integers(10, 400), min_size=1, max_size=12)


@settings(max_examples=12)
@given(STEPS, st.sampled_from([("mp4", "libx264"), ("mkv", "libx264"), ("ts", "libx264"), ("mov", "libx264")]))
def test_times_are_those_of_the_container(steps_ms: list[int], kind: tuple[str, str]) -> None:
    suffix, codec = kind
    stamps = [0, *np.cumsum(steps_ms).tolist()]
    with tempfile.TemporaryDirectory() as folder:
        seen = frames(film(Path(folder) / f"film.{suffix}", stamps, codec))
    assert [frame.error for frame in seen] == [None] * len(stamps)  # none is taken for cut off
    assert times_ms(seen) == pytest.approx(stamps, abs=1.0)


@pytest.mark.parametrize(("name", "codec"), [("f.mov", "libx265"), ("f.webm", "libvpx-vp9"), ("f.mkv", "ffv1")])
def test_other_codecs_are_read_too(name: str, codec: str, tmp_path: Path) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    seen = frames(film(tmp_path / name, range(0, 400, 40), codec))
    assert [frame.error for frame in seen] == [None] * 10
    assert seen[4].image[:20, :30].mean() > seen[4].image[40:].mean() + 80.0


def test_interlaced_film_is_deinterlaced_or_refused(tmp_path: Path) -> None:
    """Some OpenCV gives nothing of its pictures, without a word."""
    path = tmp_path / "i.mp4"
    wide = np.random.default_rng(1).integers(60, 200, (HEIGHT // 4, WIDTH // 2), np.uint8).repeat(4, 0).repeat(4, 1)
    with av.open(str(path), "w") as container:
        options = {"x264-params": "tff=1:interlaced=1", "crf": "8"}
        stream = container.add_stream("libx264", rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k in range(8):
            image = wide[:, 8 * k : 8 * k + WIDTH].copy()
            image[1::2] = wide[1::2, 8 * k + 4 : 8 * k + 4 + WIDTH]  # half a period later
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "gray")))
        container.mux(stream.encode(None))
    assert may_be_interlaced(path)
    assert not may_be_interlaced(film(tmp_path / "p.mp4", range(0, 400, 40)))
    if is_undecoded(path):
        with pytest.raises(DatasetError, match=r"i.mp4: is interlaced, .* ffmpeg -i i.mp4 -vf yadif"):
            frames(path)
        return
    for k, frame in enumerate(frames(path)):
        true = wide[::2, 8 * k : 8 * k + WIDTH].astype(float)
        assert np.corrcoef(frame.image[::2, :, 0].ravel(), true.ravel())[0, 1] > 0.9


def test_sound_and_odd_sizes_are_supported(tmp_path: Path) -> None:
    assert len(frames(film(tmp_path / "a.mp4", range(0, 400, 40), audio=True))) == 10
    odd = Camera(97, 65, 80.0, 80.0, 48.0, 32.0, 1.4)
    (first, *_) = frames(film(tmp_path / "b.mp4", range(0, 400, 40), size=(97, 65)), odd)
    assert first.image.shape == (65, 97, 3)


@pytest.mark.parametrize(("degrees", "bright"), [(90, (0, 1)), (180, (1, 1)), (270, (1, 0))])
def test_rotated_phone_film_is_upright(degrees: int, bright: tuple[int, int], tmp_path: Path) -> None:
    path = turned(film(tmp_path / "phone.mp4", range(0, 200, 40)), degrees)
    camera = CAMERA if degrees == 180 else UPRIGHT
    assert VideoRecording.frame_size(path, BagTopics()) == (camera.width_px, camera.height_px)
    image = frames(path, camera)[2].image
    assert image is not None
    halves = [np.array_split(rows, 2, axis=1) for rows in np.array_split(image, 2)]
    means = np.array([[quarter.mean() for quarter in row] for row in halves])
    assert np.unravel_index(means.argmax(), (2, 2)) == bright  # where the upper left quarter has come to
    with pytest.raises(DatasetError, match="but the given camera is"):
        frames(path, UPRIGHT if degrees == 180 else CAMERA)


@settings(max_examples=15)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(1, 3))
def test_films_of_a_directory_are_one_drive_in_natural_order(counts: list[int], stride: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for number, count in enumerate(counts):
            film(Path(folder) / f"clip{8 + number}.mp4", range(0, 40 * count, 40))  # clip9 before clip10
        (Path(folder) / "notes.txt").write_text("no film")
        (Path(folder) / "._clip8.mp4").write_text("of macOS")
        recording = open_recording(f"video:{folder}", CAMERA)
        seen = list(recording.frames())
        assert len(recording) == len(seen) == sum(counts)
        assert [frame.index for frame in seen] == list(range(sum(counts)))
        steps = np.diff(times_ms(seen))
        assert (steps > 0).all()
        assert (steps < 100).all()  # one follows the other without a gap
        assert times_ms(seen)[0] == 0
        later = list(recording.frames(start=min(3, len(seen))))
        assert times_ms(later) == times_ms(seen)[3:]


def test_gap_between_films_is_reported(tmp_path: Path) -> None:
    film(tmp_path / "20240131_120000.mp4", range(0, 2000, 40))
    film(tmp_path / "20240131_120002.mp4", range(0, 2000, 40))  # starts at the end of the first
    film(tmp_path / "20240131_120134.mp4", range(0, 400, 40))  # half a minute after the second has ended: 90 s
    seen = frames(tmp_path)
    gaps = [frame for frame in seen if frame.image is None]
    assert len(gaps) == 1
    assert "90.0 s are missing" in str(gaps[0].error)
    at = seen.index(gaps[0])
    assert at == 100
    assert seen[at + 1].t_source_ns - seen[at - 1].t_source_ns == pytest.approx(90.04e9, abs=0.1e9)
    assert seen[at - 1].t_source_ns < gaps[0].t_source_ns < seen[at + 1].t_source_ns


def test_gap_within_a_film_is_reported(tmp_path: Path) -> None:
    seen = frames(film(tmp_path / "f.mkv", [0, 40, 80, 5080, 5120, 5160]))
    assert [frame.image is None for frame in seen] == [False, False, False, True, False, False, False]
    assert times_ms(seen)[4:] == pytest.approx([5080, 5120, 5160], abs=1)


@pytest.mark.parametrize("prefix", [b"", b"\0\0\0\0"])  # cameras put a time before each packet
def test_truncated_transport_stream_is_reported(prefix: bytes, tmp_path: Path) -> None:
    whole = film(tmp_path / "whole.ts", range(0, 800, 40)).read_bytes()
    whole = b"".join(prefix + whole[at : at + 188] for at in range(0, len(whole), 188))
    for name, length in (("whole.ts", len(whole)), ("cut.ts", 2 * len(whole) // 3 // 188 * 188 + 50)):
        (tmp_path / name).write_bytes(whole[:length])
    assert [frame.error for frame in frames(tmp_path / "whole.ts")] == [None] * 20
    *seen, last = frames(tmp_path / "cut.ts")
    assert 5 < len(seen) < 20
    assert not any(frame.error for frame in seen)
    assert last.image is None
    assert last.error.endswith(f"cut.ts: ends within a packet, after {len(seen)} frames: cut off")


def test_non_film_file_is_a_one_line_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = film(tmp_path / "whole.mp4", range(0, 2000, 40)).read_bytes()
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.mp4").write_text("no film\n" * 50)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("")
    (tmp_path / "two").mkdir()
    film(tmp_path / "two" / "1.mp4", range(0, 400, 40))
    film(tmp_path / "two" / "2.mp4", range(0, 400, 40), size=(64, 64))
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        sound = container.add_stream("aac", rate=44100)
        silence = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
        silence.rate, silence.pts = 44100, 0
        container.mux([*sound.encode(silence), *sound.encode(None)])
    with av.open(str(tmp_path / "timeless.mp4"), "w") as container:  # its frames have no times
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height = WIDTH, HEIGHT
        for number in range(20):
            picture = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), number, np.uint8), "bgr24")
            picture.pts, picture.time_base = number, Fraction(1, 90_000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    one = film(tmp_path / "one.mp4", [0])
    for name, said in (
        ("none.mp4", "no such file"),
        ("empty.mp4", "empty.mp4: is empty"),
        ("cut.mp4", "cut.mp4: is cut off: no index"),
        ("text.mp4", "text.mp4: is not a video that OpenCV can open"),
        ("sound.mp4", "sound.mp4: is not a video that OpenCV can open: no images in it"),
        ("timeless.mp4", "neither its container nor its frames have a usable frame rate (nan)"),
        ("other", "no films (.mp4,"),
        ("two", "2.mp4: is 64x64, but the given camera is 96x64"),
        (one.name, "its images do not determine the lens"),
    ):
        arguments = ["run", "--source", f"video:{tmp_path / name}", "--model", "none", "--fov", "60"]
        assert main([*arguments, "--height", "1.4", "--output", str(tmp_path / "out")]) == 2, name
        told = capfd.readouterr()
        assert told.out == ""
        assert said in told.err
        assert told.err.startswith("birdslam: ")
        assert told.err.count("\n") == 1, told.err  # neither FFmpeg's words nor OpenCV's


@pytest.mark.parametrize("suffix", ["mkv", "webm"])
def test_a_recording_cut_off_before_its_length_was_written_is_read_to_its_end(suffix: str, tmp_path: Path) -> None:
    """As OBS and live streams leave them: no duration, segment of unknown size."""
    codec = "libvpx" if suffix == "webm" else "libx264"
    path = film(tmp_path / f"live.{suffix}", range(0, 400, 40), codec)
    data = bytearray(path.read_bytes())
    segment, duration = data.index(b"\x18\x53\x80\x67") + 4, data.index(b"\x44\x89\x88")
    data[segment : segment + 8] = b"\x01" + 7 * b"\xff"
    data[duration : duration + 11] = b"\xec\x89" + 9 * b"\0"  # EBML Void
    path.write_bytes(data)
    recording = VideoRecording(path, CAMERA)
    assert len(recording) == 0  # unknown
    assert [frame.image is not None for frame in recording.frames()] == [True] * 10


@pytest.mark.parametrize("suffix", ["mp4", "mov"])
def test_a_phones_metadata_state_the_focal_length(suffix: str, tmp_path: Path) -> None:
    path = film(tmp_path / f"phone.{suffix}", range(0, 200, 40), metadata={FOCAL_KEY: "26", "title": "a drive"})
    assert VideoRecording.stated_focal_px(path) == pytest.approx(WIDTH * 26 / 36)
    known = focal_length_of(Given(), f"video:{path}", (WIDTH, HEIGHT))
    assert (known.px, known.sigma_rel) == (pytest.approx(WIDTH * 26 / 36), METADATA_SIGMA_REL)
    assert "metadata" in known.by
    assert (
        "as stated, 60 deg" in focal_length_of(Given(fov_deg=60.0), f"video:{path}", (WIDTH, HEIGHT))[2]
    )  # goes before it
    measured = focal_length_of(Given(fov_deg=60.0, fov_sigma_percent=2.0), f"video:{path}", (WIDTH, HEIGHT))
    assert (measured.sigma_rel, measured.by_view) == (0.02, False)
    without = film(tmp_path / f"other.{suffix}", range(0, 200, 40))
    assert VideoRecording.stated_focal_px(without) is None
    assert "that of a phone" in focal_length_of(Given(kind="phone"), f"video:{without}", (WIDTH, HEIGHT))[2]


@pytest.mark.parametrize("kind", ["phone", "dashcam"])
def test_an_upright_camera_has_the_focal_length_of_a_level_one(kind: str) -> None:
    level, upright = (
        focal_length_of(Given(kind=kind), "video:film.mp4", size) for size in ((1920, 1080), (1080, 1920))
    )
    assert level == upright


@functools.cache
def with_metadata() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return film(Path(folder) / "f.mp4", [0, 40], metadata={FOCAL_KEY: "26"}).read_bytes()


@settings(max_examples=25)
@given(st.data())
def test_damaged_metadata_do_no_harm(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, whole = Path(folder) / "f.mp4", bytearray(with_metadata())
        begin = whole.index(b"moov")
        for _ in range(data.draw(st.integers(1, 8))):
            whole[data.draw(st.integers(begin, len(whole) - 1))] = data.draw(st.integers(0, 255))
        from birdslam.sources.films.container import stated_focal_rel, why_unreadable

        path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])
        found = stated_focal_rel(path)
        assert found is None or 5.0 / 36.0 <= found <= 300.0 / 36.0
        assert why_unreadable(path)


@pytest.mark.parametrize(
    "names",
    [
        ("2024-01-01_10-00-00-front", "2024-01-01_10-00-00-back", "2024-01-01_10-00-00-left_repeater"),
        ("20240131_120000_000123F", "20240131_120000_000124R"),
        ("20240131_120000_NF_front", "20240131_120000_NR_rear"),
    ],
)
def test_films_of_several_cameras_are_refused_with_their_names(tmp_path: Path, names: tuple[str, ...]) -> None:
    for name in names:
        film(tmp_path / f"{name}.mp4", range(0, 120, 40))
    with pytest.raises(DatasetError, match="several cameras") as error:
        open_recording(f"video:{tmp_path}", CAMERA)
    pattern = str(error.value).partition("video:")[2]
    assert len(open_recording(f"video:{pattern}", CAMERA)) == 3
    with pytest.raises(DatasetError, match="no films"):
        open_recording(f"video:{tmp_path}/*-top*", CAMERA)


def test_letters_in_file_names_do_not_split_cameras(tmp_path: Path) -> None:
    for name in ("GX010123", "GX020123", "clipA", "driver", "forward"):
        film(tmp_path / f"{name}.mp4", range(0, 120, 40))
    assert len(open_recording(f"video:{tmp_path}", CAMERA)) == 15


@pytest.mark.parametrize("name", ["film.mp4", "film.mkv", "film.avi"])
@pytest.mark.parametrize("aspect", [Fraction(4, 3), Fraction(8, 9), Fraction(1, 1)])
def test_pixels_of_anamorphic_films_are_made_square(tmp_path: Path, name: str, aspect: Fraction) -> None:
    width, height, path = 144, 108, tmp_path / name
    circle = cv2.circle(np.zeros((height, round(width * aspect), 3), np.uint8), (60, 54), 40, (255,) * 3, -1)
    coded = cv2.resize(circle, (width, height), interpolation=cv2.INTER_AREA)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4" if path.suffix == ".avi" else "libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.sample_aspect_ratio = aspect
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(coded, "bgr24")))
        container.mux(stream.encode(None))
    assert VideoRecording.frame_size(path, BagTopics()) == (round(width * aspect), height)
    camera = Camera(round(width * aspect), height, 100.0, 100.0, 60.0, 54.0, height_m=1.5)
    image = frames(path, camera)[1].image
    bright = image[..., 0] > 128
    across, down = bright.any(axis=0).sum(), bright.any(axis=1).sum()
    assert across == pytest.approx(80, abs=4)
    assert down == pytest.approx(80, abs=4)


def moving_film(path: Path, numbers: Sequence[int], quality: str = "20") -> Path:
    """Frames of a texture that moves by 3 px a frame; two films of the same numbers differ by their compression."""
    texture = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (480, 2400), dtype=np.uint8), (0, 0), 4.0)
    texture = np.asarray(cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=30, options={"crf": quality, "preset": "veryfast", "threads": "1"}
        )
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for k in numbers:
            grey = texture[100:340, 3 * k : 3 * k + 320]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.dstack([grey] * 3), "bgr24")))
        container.mux(stream.encode(None))
    return path


WIDE = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, 1.4)


@pytest.mark.parametrize("overlap", [0, 7, 75])
def test_overlapping_films_have_no_duplicate_frames(tmp_path: Path, overlap: int) -> None:
    moving_film(tmp_path / "a_001.mp4", range(120))
    moving_film(tmp_path / "a_002.mp4", range(120 - overlap, 200), quality="30")
    seen = list(open_recording(f"video:{tmp_path}", WIDE).frames())
    assert len(seen) == 200
    times = np.array([frame.t_source_ns for frame in seen])
    np.testing.assert_allclose(np.diff(times), 1e9 / 30.0, atol=2e6)
    images = [np.asarray(frame.image, np.float64)[..., 0] for frame in seen]
    step = np.abs(images[120] - images[119]).mean()
    assert step == pytest.approx(np.abs(images[100] - images[99]).mean(), rel=0.5)  # one step, neither none nor many
    later = list(open_recording(f"video:{tmp_path}", WIDE).frames(start=150))
    assert [(frame.index, frame.t_source_ns) for frame in later] == [(f.index, f.t_source_ns) for f in seen[150:]]


def test_overlap_of_films_is_removed_at_any_stride(tmp_path: Path) -> None:
    moving_film(tmp_path / "a_001.mp4", range(120))
    moving_film(tmp_path / "a_002.mp4", range(90, 200), quality="30")
    recording = open_recording(f"video:{tmp_path}", WIDE, 3)
    steps_s = np.diff([frame.t_source_ns for frame in recording.frames()]) / 1e9
    assert steps_s.sum() == pytest.approx(199 / 30.0, abs=0.11)
    np.testing.assert_allclose(steps_s, 0.1, atol=0.07)


def test_films_of_a_stationary_camera_are_not_cut(tmp_path: Path) -> None:
    moving_film(tmp_path / "a_001.mp4", [5] * 60)
    moving_film(tmp_path / "a_002.mp4", [5] * 60)
    assert len(list(open_recording(f"video:{tmp_path}", WIDE).frames())) == 120


@pytest.mark.parametrize(("codec", "suffix"), [("libx264", "h264"), ("libx265", "hevc")])
def test_a_raw_stream_is_refused_with_the_remedy(tmp_path: Path, codec: str, suffix: str) -> None:
    path = film(tmp_path / f"raw.{suffix}", range(0, 1000, 33), codec=codec)
    assert uri_of(str(path), RECORDED) == f"video:{path}"
    with pytest.raises(DatasetError, match="ffmpeg -framerate"):
        frames(path)
