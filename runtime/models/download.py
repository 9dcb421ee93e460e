"""Downloads files with a size limit and progress, completely or not at all."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

CHUNK_BYTES = 1 << 16
SCHEMES = ("https", "http")

Progress = Callable[[int, int | None], None]  # bytes received, total bytes if known


class DownloadError(ValueError):
    """A download failed; the message names the address and the reason."""


def download(address: str, target: Path, limit_bytes: int, timeout_s: float, progress: Progress) -> None:
    """Writes the file at an http(s) address to `target`; `timeout_s` applies to the connection and each wait for data.

    On failure it removes `target` and raises DownloadError: file over the limit, incomplete, or unreachable.
    """
    if urlsplit(address).scheme not in SCHEMES:
        raise DownloadError(f"{address}: unknown scheme; use {' or '.join(f'{s}://' for s in SCHEMES)}")
    try:
        _fetch(address, target, limit_bytes, timeout_s, progress)
    except DownloadError:
        target.unlink(missing_ok=True)
        raise
    except urllib.error.HTTPError as error:
        target.unlink(missing_ok=True)
        raise DownloadError(f"{address}: the server returned {error.code} {error.reason}") from error
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        target.unlink(missing_ok=True)
        raise DownloadError(f"{address}: {getattr(error, 'reason', None) or error}") from error


def _fetch(address: str, target: Path, limit_bytes: int, timeout_s: float, progress: Progress) -> None:
    request = urllib.request.Request(address, headers={"User-Agent": "birdslam"})
    opener = urllib.request.build_opener(_Redirects)
    with opener.open(request, timeout=timeout_s) as response, target.open("wb") as file:
        announced = response.headers.get("Content-Length")
        total_bytes = int(announced) if announced is not None and announced.isdigit() else None
        if total_bytes is not None and total_bytes > limit_bytes:
            raise DownloadError(f"{address}: {total_bytes} bytes are over the limit of {limit_bytes}")
        got_bytes = 0
        while chunk := response.read(CHUNK_BYTES):
            got_bytes += len(chunk)
            if got_bytes > limit_bytes:
                raise DownloadError(f"{address}: more than the limit of {limit_bytes} bytes")
            file.write(chunk)
            progress(got_bytes, total_bytes)
        if total_bytes is not None and got_bytes < total_bytes:
            raise DownloadError(f"{address}: interrupted after {got_bytes} of {total_bytes} bytes")


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to http(s) addresses only."""

    def redirect_request(self, request: Any, file: Any, code: Any, message: Any, headers: Any, address: str) -> Any:
        if urlsplit(address).scheme not in SCHEMES:
            raise DownloadError(f"{request.full_url}: redirects to {address}, not an {' or '.join(SCHEMES)} address")
        return super().redirect_request(request, file, code, message, headers, address)
