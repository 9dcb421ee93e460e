"""rerun's viewer for a browser, on this computer alone: `birdslam view ... --web`.

A server of rerun's own, a process that ends with us, keeps the newest of what is sent to it for browsers that come
later. The viewer goes through a server of ours, which adds a content security policy: left to itself rerun's page asks
its makers' servers, for fonts and newer releases and to tell of its use. All is at 127.0.0.1 and nowhere else.
"""

from __future__ import annotations

import http.client
import socket
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
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
# The page runs its own scripts and compiled code, and speaks with this computer
POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    f"style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob: http://{LOOPBACK}:*"
)


class _Page(ThreadingHTTPServer):
    """rerun's page with the policy."""

    daemon_threads = True

    def __init__(self, port: int, viewer_port: int) -> None:
        self.viewer_port = viewer_port
        super().__init__((LOOPBACK, port), _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Page

    def do_GET(self) -> None:
        """What rerun's server says, with the policy."""
        connection = http.client.HTTPConnection(LOOPBACK, self.server.viewer_port, timeout=BEGIN_S)
        try:
            connection.request("GET", self.path)
            answer = connection.getresponse()
            body = answer.read()
        except OSError:
            self.send_error(502)
            return
        finally:
            connection.close()
        self.send_response(answer.status)
        for name in ("Content-Type", "Content-Encoding"):
            if value := answer.getheader(name):
                self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *values: object) -> None:
        """Says nothing of what is asked."""


class WebViewer(Closing):
    """A context manager. Raises ConfigurationError where it can't be served at this port."""

    def __init__(self, port: int) -> None:
        data_port, viewer_port = _free(0), _free(0)
        try:
            self._page = _Page(port, viewer_port)
        except (OSError, OverflowError) as error:
            raise ConfigurationError(f"view: --web {port}: {error}") from None
        threading.Thread(target=self._page.serve_forever, name="web", daemon=True).start()
        self.data = f"rerun+http://{LOOPBACK}:{data_port}/proxy"  # where a stream is sent to
        self.page = f"http://{LOOPBACK}:{self._page.server_port}/?url={quote(self.data, safe='')}"
        ports = ("--port", str(data_port), "--web-viewer-port", str(viewer_port))
        program = Path(rerun_cli.__file__).with_name("rerun")  # without its wrapper, which would outlive it
        command = [str(program), "--serve-web", "--bind", LOOPBACK, *ports, "--server-memory-limit", KEPT]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            self._wait_for(viewer_port)
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
        self._page.shutdown()
        self._page.server_close()
        self._process.terminate()
        self._process.communicate()


def _free(port: int) -> int:
    """A port of this computer; 0: any."""
    with socket.socket() as holder:
        holder.bind((LOOPBACK, port))
        taken: int = holder.getsockname()[1]
        return taken
