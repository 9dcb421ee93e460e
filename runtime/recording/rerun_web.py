"""rerun's viewer in a browser, local to this computer: `birdslam view ... --web`.

A rerun server process keeps the newest data for browsers. A proxy adds a content security policy, since rerun's page
would contact external servers for fonts, updates and telemetry. Both listen on 127.0.0.1 only.
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
MEMORY_LIMIT = "512MiB"  # of the newest data
START_TIMEOUT_S, RETRY_S = 30.0, 0.05
# The page may run its own scripts and WebAssembly, and connect to this computer
POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    f"style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob: http://{LOOPBACK}:*"
)


class _Page(ThreadingHTTPServer):
    """The proxy server of rerun's page."""

    daemon_threads = True

    def __init__(self, port: int, viewer_port: int) -> None:
        self.viewer_port = viewer_port
        super().__init__((LOOPBACK, port), _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Page

    def do_GET(self) -> None:
        """Forwards the response of rerun's server with the policy."""
        connection = http.client.HTTPConnection(LOOPBACK, self.server.viewer_port, timeout=START_TIMEOUT_S)
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
        """Does not log requests."""


class WebViewer(Closing):
    """Serves the viewer; a context manager. Raises ConfigurationError if the port is not available."""

    def __init__(self, port: int) -> None:
        data_port, viewer_port = _free(0), _free(0)
        try:
            self._page = _Page(port, viewer_port)
        except (OSError, OverflowError) as error:
            raise ConfigurationError(f"view: --web {port}: {error}") from None
        threading.Thread(target=self._page.serve_forever, name="web", daemon=True).start()
        self.data = f"rerun+http://{LOOPBACK}:{data_port}/proxy"  # target of the stream
        self.page = f"http://{LOOPBACK}:{self._page.server_port}/?url={quote(self.data, safe='')}"
        ports = ("--port", str(data_port), "--web-viewer-port", str(viewer_port))
        program = Path(rerun_cli.__file__).with_name("rerun")  # without its wrapper, which would outlive it
        command = [str(program), "--serve-web", "--bind", LOOPBACK, *ports, "--server-memory-limit", MEMORY_LIMIT]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            self._wait_for(viewer_port)
            self._wait_for(data_port)
        except BaseException:
            self.close()
            raise

    def _wait_for(self, port: int) -> None:
        until_s = time.monotonic() + START_TIMEOUT_S
        while True:
            if self._process.poll() is not None or time.monotonic() > until_s:
                self._process.kill()
                output = self._process.communicate()[1].decode(errors="replace").strip()
                raise ConfigurationError(f"view: --web: no server at {LOOPBACK}:{port}: {output[-500:]}")
            try:
                socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            except OSError:
                time.sleep(RETRY_S)
            else:
                return

    def wait(self) -> None:
        """Waits for the end of the server, for example by Ctrl-C."""
        self._process.communicate()

    def close(self) -> None:
        """Ends both servers."""
        self._page.shutdown()
        self._page.server_close()
        self._process.terminate()
        self._process.communicate()


def _free(port: int) -> int:
    """Returns a free port of this computer; 0: any."""
    with socket.socket() as holder:
        holder.bind((LOOPBACK, port))
        taken: int = holder.getsockname()[1]
        return taken
