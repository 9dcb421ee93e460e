"""`birdslam models`: installed models are complete, pinned and consistent; refused ones leave nothing behind."""

from __future__ import annotations

import functools
import hashlib
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx.external_data_helper import set_external_data

from birdslam.perception import ModelError, ModelSpec, load_network, shipped_manifests
from birdslam.perception.manifest_file import read_manifest
from birdslam.perception.onnx_files.onnx_file import has_external_weights
from birdslam.runtime.cli.commands import parse
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.models import catalogue as catalogue_module
from birdslam.runtime.models import store as model_store
from birdslam.runtime.models.download import DownloadError, download
from birdslam.runtime.options import configuration_of
from tests import tiny_networks as tiny
from tests.tiny_networks import DETECTOR, SEGMENTER


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A directory and the loopback address under which its files are served."""
    (tmp_path / "served").mkdir()
    yield from serve_files(tmp_path / "served")


def serve_files(root: Path) -> Iterator[tuple[Path, str]]:
    yield from serve(functools.partial(Quiet, directory=str(root)), root)


def serve(handler: Any, root: Path) -> Iterator[tuple[Path, str]]:
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever)
        thread.start()
        try:
            yield root, f"http://127.0.0.1:{httpd.server_address[1]}"
        finally:
            httpd.shutdown()
            thread.join()


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data" / "birdslam" / "models"


def segmenter(directory: Path, name: str = "seg") -> Path:
    network = tiny.echo(directory / f"{name}.onnx", (1, 3, 16, 32))
    network.with_suffix(".toml").write_text(SEGMENTER)
    return network


def detector(directory: Path, name: str = "det") -> Path:
    network = tiny.constant(directory / f"{name}.onnx", (1, 3, 64, 64), np.zeros((1, 84, 6), np.float32))
    network.with_suffix(".toml").write_text(DETECTOR.replace("classes = 2", "classes = 1"))
    return network


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def left_in(store: Path) -> set[str]:
    return {path.name for path in store.glob("*")} - {".lock"} if store.exists() else set()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["models", *arguments]) == 2
    return capsys.readouterr().err


def test_files_are_installed_pinned_and_found_by_name(tmp_path: Path, store: Path) -> None:
    networks = segmenter(tmp_path), detector(tmp_path)
    assert main(["models", "add", *map(str, networks)]) == 0
    assert left_in(store) == {"seg", "det"}
    for network in networks:
        copy = store / network.stem / network.name
        assert copy.read_bytes() == network.read_bytes()
        assert read_manifest(copy.with_suffix(".toml")).sha256 == sha256(network)
    options = parse(["run", "--model", "seg", "--model", "detector=det"])
    given = configuration_of(options).models.given()
    assert given == {
        "detector": ModelSpec(str(store / "det" / "det.onnx")),
        "segmenter": ModelSpec(str(store / "seg" / "seg.onnx")),
    }
    for role, spec in given.items():
        load_network(role, spec)


def test_a_configuration_file_may_name_models_and_their_directory(tmp_path: Path, store: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    assert main(["models", "add", str(segmenter(tmp_path)), "--directory", str(elsewhere)]) == 0
    assert left_in(store) == set()
    path = tmp_path / "car.toml"
    path.write_text('[runtime]\nmodels_dir = "elsewhere"\n[models.segmenter]\npath = "seg"\nevery = 4\n')
    made = configuration_of(parse(["run", str(path)]))
    assert made.models.segmenter == ModelSpec(str(elsewhere / "seg" / "seg.onnx"), every=4)
    with pytest.raises(ConfigurationError, match=r"no model 'det': available are .*seg"):
        configuration_of(parse(["run", str(path), "--model", "det"]))


def test_a_changed_file_of_an_installed_model_is_refused_when_it_is_loaded(tmp_path: Path, store: Path) -> None:
    main(["models", "add", str(segmenter(tmp_path))])
    network = store / "seg" / "seg.onnx"
    tiny.echo(network, (1, 3, 16, 32), outputs=("output", "more"))
    with pytest.raises(ModelError, match="sha256: the manifest"):
        load_network("segmenter", ModelSpec(str(network)))


def test_adding_again_replaces(tmp_path: Path, store: Path) -> None:
    main(["models", "add", str(segmenter(tmp_path))])
    other = tiny.echo(tmp_path / "seg.onnx", (1, 3, 16, 32), outputs=("output", "more"))
    assert main(["models", "add", str(other)]) == 0
    assert left_in(store) == {"seg"}
    assert sha256(store / "seg" / "seg.onnx") == sha256(other)


def test_leftovers_of_a_killed_add_are_removed_by_the_next(tmp_path: Path, store: Path) -> None:
    (store / ".adding-abc").mkdir(parents=True)
    (store / ".adding-abc" / "half").write_bytes(b"x")
    main(["models", "add", str(segmenter(tmp_path))])
    assert left_in(store) == {"seg"}


@pytest.mark.parametrize("old", [False, True], ids=["new", "over an old one"])
def test_a_refused_network_leaves_nothing_and_names_the_reason(
    tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str], old: bool
) -> None:
    network = segmenter(tmp_path)
    kept = sha256(network)
    if old:
        main(["models", "add", str(network)])
    network.write_bytes(tiny.echo(tmp_path / "x.onnx", (1, 3, 16, 32), outputs=("output", "b")).read_bytes())
    has = sha256(network)
    for wrong, named in (
        (("--sha256", "0" * 64), f"SHA-256 {has}, but {'0' * 64} was expected"),
        (("--sha256", "zz"), "64 hexadecimal digits"),
        (("--limit-mb", "0.0001"), "bytes are over the limit of 100"),
        (("--manifest", str(tmp_path / "none.toml")), "none.toml"),
        (("--name", "a/b"), "--name a/b"),
    ):
        message = refused(capsys, "add", str(network), *wrong)
        assert named in message
    network.with_suffix(".toml").write_text(SEGMENTER.replace("channels = 3", "channels = 4"))
    message = refused(capsys, "add", str(network))
    assert f"refused: {network}: segmenter.maps[0].channels: the manifest says 4, the network has 3" in message
    assert left_in(store) == ({"seg"} if old else set())
    if old:
        assert sha256(store / "seg" / "seg.onnx") == kept


def test_non_finite_network_is_refused(tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network = tiny.constant(tmp_path / "nan.onnx", (1, 3, 64, 64), np.full((1, 84, 6), np.nan, np.float32))
    network.with_suffix(".toml").write_text(DETECTOR.replace("classes = 2", "classes = 1"))
    assert "not finite" in refused(capsys, "add", str(network))
    assert "not finite" in refused(capsys, "check", str(network))
    assert left_in(store) == set()


def with_external_data(path: Path, inside_subgraph: bool) -> bytes:
    tensor = numpy_helper.from_array(np.ones((4, 4), np.float32), "w")
    set_external_data(tensor, location="../secret.bin")
    tensor.ClearField("raw_data")
    nodes = [helper.make_node("MatMul", ["images", "w"], ["output"])]
    if inside_subgraph:
        nodes.insert(0, helper.make_node("Constant", [], ["w"], value=tensor))
    rows = [helper.make_tensor_value_info(n, TensorProto.FLOAT, (1, 4)) for n in ("images", "output")]
    graph = helper.make_graph(nodes, "g", rows[:1], rows[1:], [] if inside_subgraph else [tensor])
    path.write_bytes(helper.make_model(graph).SerializeToString())
    return path.read_bytes()


@pytest.mark.parametrize("inside_subgraph", [False, True])
def test_weights_in_another_file_are_refused_before_anything_is_read(
    tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str], inside_subgraph: bool
) -> None:
    network = segmenter(tmp_path)
    assert not has_external_weights(network.read_bytes())
    assert has_external_weights(with_external_data(network, inside_subgraph))
    assert "its weights are in another file" in refused(capsys, "add", str(network))
    assert left_in(store) == set()


def catalogue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, network: Path, **changed: Any) -> None:
    name = next(iter(shipped_manifests()))
    entry = {
        "title": "one",
        "manifest": name,
        "repository": "some/where",
        "commit": "a" * 40,
        "path": "models/net.onnx",
        "sha256": sha256(network),
        "size_bytes": network.stat().st_size,
        "licence": "MIT",
        **changed,
    }
    lines = [f"{key} = {value!r}" for key, value in entry.items()]
    path = tmp_path / "catalogue.toml"
    path.write_text("\n".join([f'address = "{address}/{{repository}}/{{commit}}/{{path}}"', "[models.net]", *lines]))
    monkeypatch.setattr(catalogue_module, "CATALOGUE", path)


def served_network(root: Path) -> Path:
    directory = root / "some" / "where" / ("a" * 40) / "models"
    directory.mkdir(parents=True)
    return segmenter(directory, "net")


def test_a_name_of_the_catalogue_is_fetched_and_pinned(
    tmp_path: Path, store: Path, server: tuple[Path, str], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    network = served_network(server[0])
    catalogue(tmp_path, monkeypatch, server[1], network)
    with pytest.MonkeyPatch.context() as patch:  # a manifest of the package that fits the tiny network
        shipped = tmp_path / "manifests"
        shipped.mkdir()
        (shipped / "one.toml").write_text(f'sha256 = "{sha256(network)}"\n{SEGMENTER}')
        patch.setattr("birdslam.perception.manifest_file.SHIPPED_DIRECTORY", shipped)
        catalogue(tmp_path, monkeypatch, server[1], network, manifest="one")
        main(["models", "list"])
        assert re.search("net +catalogue", capsys.readouterr().out)
        assert main(["models", "add", "net"]) == 0
        main(["models", "list"])
        assert re.search("net +installed", capsys.readouterr().out)
        assert (store / "net" / "net.onnx").read_bytes() == network.read_bytes()

        catalogue(tmp_path, monkeypatch, server[1], network, manifest="one", sha256="1" * 64)
        assert f"but {'1' * 64} was expected" in refused(capsys, "add", "net")
        catalogue(tmp_path, monkeypatch, server[1], network, manifest="one", size_bytes=10)
        assert "over the limit of 10" in refused(capsys, "add", "net")
        catalogue(tmp_path, monkeypatch, server[1], network, manifest="one", path="gone.onnx")
        assert "gone.onnx: the server returned 404" in refused(capsys, "add", "net")
    assert left_in(store) == {"net"}
    assert "which has net" in refused(capsys, "add", "nowhere")


def test_an_address_needs_a_hash_and_brings_its_manifest(
    store: Path, server: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    root, address = server
    network = segmenter(root)
    assert "its SHA-256 is unknown" in refused(capsys, "add", f"{address}/seg.onnx")
    assert left_in(store) == set()
    assert main(["models", "add", f"{address}/seg.onnx", "--sha256", sha256(network).upper()]) == 0
    network.with_suffix(".toml").write_text(f'sha256 = "{sha256(network)}"\n{SEGMENTER}')
    assert main(["models", "add", f"{address}/seg.onnx", "--name", "again"]) == 0
    assert left_in(store) == {"seg", "again"}
    assert str(network.stem) in configuration_of(parse(["run", "--model", "again"])).models.given()[
        "segmenter"
    ].path.replace("again", "seg")


def test_download_is_atomic(tmp_path: Path) -> None:
    class Liar(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(302 if self.path == "/away" else 200)
            if self.path == "/short":
                self.send_header("Content-Length", "1000")
            if self.path == "/away":
                self.send_header("Location", "ftp://127.0.0.1/file")
            self.end_headers()
            self.wfile.write(b"x" * (5000 if self.path == "/long" else 100))

        def log_message(self, *_: Any) -> None:
            pass

    seen: list[tuple[int, int | None]] = []
    target = tmp_path / "file"
    for _, address in serve(Liar, tmp_path):
        for path, named in (
            ("short", "interrupted after 100 of 1000"),
            ("long", "more than the limit"),
            ("away", "redirects to ftp"),
        ):
            with pytest.raises(DownloadError, match=named):
                download(f"{address}/{path}", target, 1000, 5.0, lambda *n: seen.append(n))
            assert not target.exists()
        download(f"{address}/fine", target, 1000, 5.0, lambda *n: seen.append(n))
        assert target.read_bytes() == b"x" * 100
        assert seen[-1] == (100, None)
    with pytest.raises(DownloadError, match="unknown scheme"):
        download("file:///etc/passwd", target, 1000, 5.0, lambda *n: None)


def test_check_takes_a_network_a_manifest_or_a_name(
    tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = segmenter(tmp_path)
    main(["models", "add", str(network)])
    capsys.readouterr()
    for file in (str(network), str(network.with_suffix(".toml")), "seg"):
        assert main(["models", "check", file]) == 0
        out = capsys.readouterr().out
        assert "fits its manifest" in out
        assert "output (1, 3, 16, 32)" in out
        assert sha256(network) in out
    assert "channel: 5 is not one of" in _of_manifest(network, capsys, SEGMENTER.replace("channel = 1", "channel = 5"))
    assert "input.width_px" in _of_manifest(network, capsys, SEGMENTER.replace("width_px = 32", "width_px = 64"))
    network.unlink()
    assert "can't be read" in refused(capsys, "check", str(network.with_suffix(".toml")))


def _of_manifest(network: Path, capsys: pytest.CaptureFixture[str], text: str) -> str:
    network.with_suffix(".toml").write_text(text)
    return refused(capsys, "check", str(network))


def test_list_reports_broken_models(tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["models", "add", str(segmenter(tmp_path))])
    (store / "seg" / "seg.onnx").write_bytes(b"changed")
    (store / "not a model").mkdir()
    capsys.readouterr()
    assert main(["models", "list"]) == 0
    out = capsys.readouterr().out
    assert "unusable" in out
    assert "not a model" not in out


def test_the_catalogue_is_sound() -> None:
    known = catalogue_module.catalogue()
    for name, entry in known.models.items():
        assert model_store.is_name(name)
        assert read_manifest(shipped_manifests()[entry.manifest]).sha256 == (entry.sha256 or "")
        assert known.address_of(entry).endswith(f"{entry.commit}/{entry.path}")


def test_without_any_home_the_directory_must_be_stated(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", "/h")
    assert model_store.models_directory() == Path("/h/.local/share/birdslam/models")
    monkeypatch.delenv("HOME")
    with pytest.raises(ModelError, match="models_dir"):
        model_store.models_directory()
    assert model_store.models_directory(tmp_path) == tmp_path
