"""The configuration: differences from the defaults, and errors that name the file and the key."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.graph.graph_config import GraphConfig
from birdslam.paper import PAPER
from birdslam.perception import ModelSpec
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete, dump, load, parse_setting
from birdslam.runtime.fields import fields, stands_for
from birdslam.runtime.keys import GROUPS, KEYS

ROOT = Path(__file__).resolve().parent.parent
CAMERA = "width_px = 64\nheight_px = 32\nfx_px = 50\nfy_px = 50\ncx_px = 32\ncy_px = 16\nheight_m = 1.5\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_differences_only(tmp_path: Path) -> None:
    path = write(tmp_path / "a.toml", 'vehicle = "van"\n[source]\nrate = 33\n[perceive]\nopencv_threads = 3\n')
    configuration = load(path)
    assert (configuration.vehicle, configuration.source.rate) == ("van", 33.0)
    assert configuration.perceive.opencv_threads == 3
    assert configuration.slam == Configuration().slam


@pytest.mark.parametrize(
    ("text", "key", "reason"),
    [
        ("[source]\npace = 3\n", "source.pace", "no such key"),
        ("[slam.graph]\nlagg = 3\n", "slam.graph.lagg", "no such key"),
        ("[source]\nstrides = 3\n", "source.strides", "; the nearest is source.stride"),
        ("[sourc]\nstride = 3\n", "sourc", "; the nearest is source"),
        ("colour = 1\n", "colour", "no such key"),
        ('[source]\nstride = "two"\n', "source.stride", "Expected `int`, got `str`"),
        ("[source]\nstride = 0\n", "source.stride", ">= 1"),
        ("[source]\nrate = -1.0\n", "source.rate", "> 0"),
        ('[source]\nrate = "fast"\n', "source.rate", "fast"),
        ('vehicle = "a/b"\n', "vehicle", "matching regex"),
        ("source = 5\n", "source", "Expected `object`"),
        ('[models.detektor]\npath = "x"\n', "models.detektor", "no such key; the nearest is models.detector"),
        ("[camera]\nwidth_px = 64\n", "camera", "missing required field"),
        (f"[camera]\n{CAMERA.replace('1.5', '15.0')}", "camera", "height_m = 15.0"),
    ],
)
def test_a_wrong_key_names_the_file_and_the_key(tmp_path: Path, text: str, key: str, reason: str) -> None:
    path = write(tmp_path / "wrong.toml", text)
    with pytest.raises(ConfigurationError) as error:
        load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: {key}: ")
    assert reason in message


def test_a_missing_or_invalid_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"missing\.toml: No such file"):
        load(tmp_path / "missing.toml")
    with pytest.raises(ConfigurationError, match=r"a\.toml: not TOML: .*line 1"):
        load(write(tmp_path / "a.toml", "= 5"))


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "conf").mkdir()
    write(tmp_path / "conf" / "front.toml", CAMERA)
    text = (
        'camera = "front.toml"\noutput = "../out"\n[source]\nuri = "kitti:../00"\n[runtime]\nruntime_dir = "run"\n'
        '[models.detector]\npath = "net.onnx"\nmanifest = "mine.toml"\n'
        '[models.segmenter]\npath = "/other.onnx"\nmanifest = "shipped"\n'
    )
    configuration = load(write(tmp_path / "conf" / "a.toml", text))
    base = tmp_path / "conf"
    assert configuration.camera == Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5)
    assert configuration.source.uri == f"kitti:{base}/../00"
    assert (configuration.output, configuration.runtime_dir) == (f"{base}/../out", base / "run")
    assert configuration.models.given() == {
        "detector": ModelSpec(f"{base}/net.onnx", f"{base}/mine.toml"),
        "segmenter": ModelSpec("/other.onnx", "shipped"),
    }


def test_the_shipped_network_takes_the_missing_roles() -> None:
    own = ModelSpec("own.onnx")
    assert list(load(None).models.in_use()) == ["multitask"]
    assert Path(load(None).models.in_use()["multitask"].path).is_file()
    beside = load(None, {"models.detector.path": "own.onnx"}).models
    assert beside.given() == {"detector": own}
    assert list(beside.in_use()) == ["detector", "multitask"]
    paths = {f"models.{role}.path": "own.onnx" for role in ("detector", "segmenter", "depth")}
    assert list(load(None, paths).models.in_use()) == ["detector", "segmenter", "depth"]
    assert load(None, {"models.multitask.path": "own.onnx"}).models.in_use() == {"multitask": own}
    both = {"models.detector.path": "own.onnx", "models.segmenter.path": "own.onnx"}
    assert list(load(None, both).models.in_use()) == ["detector", "segmenter"]
    assert list(load(None, both | {"models.bodies": True}).models.in_use()) == ["detector", "segmenter", "multitask"]
    assert load(None, {"models.shipped": False}).models.in_use() == {}


def test_a_camera_file_can_be_pinned(tmp_path: Path) -> None:
    path = tmp_path / "front.toml"
    path.write_text(CAMERA)
    pin = hashlib.sha256(path.read_bytes()).hexdigest()
    assert load(None, {"camera": str(path), "camera_sha256": pin}).camera is not None
    path.write_text(CAMERA.replace("1.5", "1.6"))
    with pytest.raises(ConfigurationError, match=f"front.toml: its sha256 is .* but camera_sha256 is {pin}"):
        load(None, {"camera": str(path), "camera_sha256": pin})
    with pytest.raises(ConfigurationError, match="there is no camera file"):
        load(None, {"camera_sha256": pin})
    with pytest.raises(ConfigurationError, match="camera_sha256"):
        load(None, {"camera": str(path), "camera_sha256": "not a hash"})
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        load(None, {"camera": str(tmp_path / "none.toml"), "camera_sha256": pin})


def test_an_invalid_camera_file_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "front.toml", CAMERA + "zoom = 3\n")
    with pytest.raises(ConfigurationError, match=r"camera file .*front\.toml: .*zoom"):
        load(None, {"camera": str(path)})


def test_overrides_replace_the_file_and_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.toml", "[source]\nrate = 10\nstride = 2\n[models.detector]\nevery = 3\n")
    configuration = load(path, {"source.rate": "max", "models.detector.path": "net.onnx"})
    assert configuration.lossless
    assert configuration.source.stride == 2
    assert configuration.models.detector == ModelSpec("net.onnx", every=3)
    with pytest.raises(ConfigurationError, match=r"^command line: source\.stride: "):
        load(path, {"source.stride": "two"})
    with pytest.raises(ConfigurationError, match=r"^command line: source\.stride\.deep: stride is not a table"):
        load(path, {"source.stride.deep": 1})
    with pytest.raises(ConfigurationError, match=r"a\.toml: models\.detector: .*path"):
        load(path)


@given(
    st.one_of(
        st.integers(-(2**62), 2**62),
        st.floats(allow_nan=False, allow_infinity=False),
        st.booleans(),
        st.from_regex(r"[a-z:/_.\-]{1,20}", fullmatch=True).filter(lambda s: s not in ("true", "false", "inf", "nan")),
    )
)
def test_settings_are_toml_or_text(value: object) -> None:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    key, parsed = parse_setting(f"source.x={text}")
    assert (key, parsed) == ("source.x", value)
    assert type(parsed) is type(value)


def test_a_setting_needs_a_key_and_a_value() -> None:
    for text in ("source.rate", "=3"):
        with pytest.raises(ConfigurationError, match="expected KEY=VALUE"):
            parse_setting(text)


def test_dump_round_trips() -> None:
    configuration = load(None, {"source.rate": 12.5, "models.detector.path": "n.onnx", "slam.graph.forget_s": 0.7})
    assert msgspec.convert(dump(configuration), Configuration) == configuration
    assert msgspec.json.decode(msgspec.json.encode(configuration), type=Configuration) == configuration


def test_the_deadline_follows_the_frame_rate() -> None:
    camera = Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5)
    slow, fast = (complete(Configuration(), camera, rate_hz).deadline_ns for rate_hz in (10.0, 40.0))
    assert slow == pytest.approx(4.0 * fast)
    paced = complete(load(None, {"source.rate": 40.0}), camera, 10.0)
    assert (paced.camera, paced.deadline_ns) == (camera, fast)
    assert complete(load(None, {"perceive.deadline_ms": 7.0}), camera, 10.0).deadline_ns == 7_000_000
    assert complete(load(None, {"source.rate": "max"}), camera, 10.0).deadline_ns is None


@pytest.mark.parametrize("name", ["kitti", "vehicle", "paper"])
def test_the_examples_load(name: str) -> None:
    assert load(ROOT / "configs" / f"{name}.toml") != Configuration()


def test_every_key_is_a_field_and_has_a_meaning() -> None:
    known = [field.key for field in fields(Configuration)]
    for key, meaning in KEYS.items():
        assert any(stands_for(key, name) for name in known), key
        assert 5 < len(meaning) < 200, key
    assert len(KEYS) == sum(len(group.meanings) for group in GROUPS) <= 120


def test_method_paper_selects_the_method_of_the_paper(tmp_path: Path) -> None:
    assert load(ROOT / "configs" / "paper.toml").slam == PAPER
    path = write(tmp_path / "a.toml", 'method = "paper"\n[slam.graph]\nforget_s = 2.0\n')
    graph = msgspec.structs.replace(PAPER.graph, forget_s=2.0)
    assert load(path).slam == msgspec.structs.replace(PAPER, graph=graph)
    assert load(path, {"method": "birdslam"}).slam.graph == GraphConfig(forget_s=2.0)
    varied = load(path, {"slam.graph.forget_s": 1.0, "slam.graph.constant_velocity": True}).slam.graph
    assert varied == msgspec.structs.replace(PAPER.graph, constant_velocity=True)
    one_class = "[slam.frontend.localisation.vehicles.car]\nlength_m = 4.5\nwidth_m = 1.8\nheight_m = 1.5\n"
    for method in ("birdslam", "paper"):
        slam = load(write(path, f'method = "{method}"\n{one_class}')).slam
        assert {name: size.length_m for name, size in slam.frontend.localisation.vehicles.items()} == {"car": 4.5}
    for wrong in ("nobody's", 3, ["paper"]):
        with pytest.raises(ConfigurationError, match="command line: method: "):
            load(None, {"method": wrong})
