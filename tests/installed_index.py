"""From an index, without an installation: `make index-test`.

Wheel and source distribution lie in an index of this computer (PEP 503, over HTTP at loopback) beside that of all else,
from which `uvx` and `pipx run` drive the shipped drive, on each Python of *requires-python* that is here.
"""

from __future__ import annotations

import functools
import os
import shutil
import sys
import tempfile
import threading
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from tests.installed_wheel import build, call, drive

PYTHONS = "3.11", "3.12", "3.13"


class Quiet(SimpleHTTPRequestHandler):
    """Lists a folder as an index does, without logging."""

    def log_message(self, text: str, *values: object) -> None:
        return


@contextmanager
def index(files: Path) -> Iterator[str]:
    """The URL of an index with one project, whose files these are."""
    folder = files.parent / "index"
    folder.mkdir()
    shutil.copytree(files, folder / "birdslam")
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()


def interpreters() -> dict[str, Path]:
    """The Pythons that answer."""
    found = {}
    for version in PYTHONS:
        program = shutil.which(f"python{version}")
        if program is None:
            continue
        try:
            where = call(program, "-c", "import sys; print(sys.executable)", cwd=Path("/"))
        except AssertionError:  # of a version manager: the name is there, the interpreter is not
            continue
        found[version] = Path(where.strip())
    return found


def environment(place: Path) -> dict[str, str]:
    """How packages are got here, and where they are kept meanwhile."""
    own = {key: value for key, value in os.environ.items() if key.startswith(("PIP_", "UV_", "SSL_"))}
    if "PIP_CERT" in own:  # which uv does not read
        own.setdefault("SSL_CERT_FILE", own["PIP_CERT"])
    caches = {"UV_CACHE_DIR": "uv", "PIP_CACHE_DIR": "pip", "PIPX_HOME": "pipx"}
    return own | {key: str(place / "caches" / name) for key, name in caches.items()}


def main(wanted: list[str]) -> None:
    with tempfile.TemporaryDirectory(prefix="index-") as name:
        place = Path(name)
        build(place / "files")
        tools = place / "tools"
        venv.create(tools, with_pip=False, symlinks=True)
        pip = (sys.executable, "-m", "pip", "--python", tools / "bin" / "python", "--disable-pip-version-check")
        call(*pip, "install", "--quiet", "uv", "pipx", cwd=place)
        there = interpreters()
        with index(place / "files") as url:
            for version in wanted or PYTHONS:
                if version not in there:
                    print(f"Python {version}: is not here")
                    continue
                python = there[version]
                for tool, command in {
                    "uvx": [tools / "bin" / "uvx", "--python", python, "--index", url, "birdslam"],
                    "pipx": [
                        *(tools / "bin" / "pipx", "run", "--python", python),
                        *("--pip-args", f"--extra-index-url {url} --trusted-host 127.0.0.1", "birdslam"),
                    ],
                }.items():
                    folder = place / f"{tool}-{version}"
                    drive(command, folder, **environment(place))
                    print(f"{tool} on Python {version}: the shipped drive, from the index at {url}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
