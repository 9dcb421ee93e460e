"""rerun's viewer for a browser, on this computer alone: `birdslam view ... --web`.

A server of rerun's own, a process that ends with us: it keeps the newest of what is sent to it for browsers that come
later, and gives them the viewer and the data, both at 127.0.0.1 and nowhere else.
"""

from __future__ import annotations

import socket
import subprocess
import time
from pathlib import Path
from urllib.parse import quote

from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.transport.closing import Closing

try:
    import rerun_cli
except ImportError as error:
    raise ConfigurationError(f"view: needs rerun: pip install 'birdslam[view]' ({error})") from None

LOOPBACK = "127.0.0.1"
KEPT = "512MiB"  # of data, the newest
BEGIN_S, AGAIN_S = 30.0, 0.05


class WebViewer(Closing):
    """A context manager. Raises ConfigurationError where it can't be served at this port."""

    def __init__(self, port: int) -> None:
        data_port = _free(0)
        self.data = f"rerun+http://{LOOPBACK}:{data_port}/proxy"  # where a stream is sent to
        self.page = f"http://{LOOPBACK}:{_free(port)}/?url={quote(self.data, safe='')}"
        ports = ("--port", str(data_port), "--web-viewer-port", str(port))
        program = Path(rerun_cli.__file__).with_name("rerun")  # without its wrapper, which would outlive it
        command = [str(program), "--serve-web", "--bind", LOOPBACK, *ports, "--server-memory-limit", KEPT]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            self._wait_for(port)
            self._wait_for(data_port)
        except BaseException:
            self.close()
            raise

    def _wait_for(self, port: int) -> None:
        until_s = time.monotonic() + BEGIN_S
        while True:
            if self._process.poll() is not None or time.monotonic() > until_s:
                self._process.kill()
                said = self._process.communicate()[1].decode(errors="replace").strip()
                raise ConfigurationError(f"view: --web: nothing is served at {LOOPBACK}:{port}: {said[-500:]}")
            try:
                socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            except OSError:
                time.sleep(AGAIN_S)
            else:
                return

    def wait(self) -> None:
        """Until it ends, as by Ctrl-C."""
        self._process.communicate()

    def close(self) -> None:
        """Ends it."""
        self._process.terminate()
        self._process.communicate()


def _free(port: int) -> int:
    """A port of this computer; 0: any. Raises ConfigurationError where somebody has it."""
    with socket.socket() as holder:
        try:
            holder.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise ConfigurationError(f"view: --web {port}: {error}") from None
        taken: int = holder.getsockname()[1]
        return taken
