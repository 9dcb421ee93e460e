"""Certificates of deploy/certificates.sh, and sessions from outside that use them."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

SCRIPT = Path(__file__).resolve().parent.parent / "deploy/certificates.sh"

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")


def certificate(folder: Path, *what: str) -> None:
    subprocess.run([str(SCRIPT), str(folder), *what], check=True, capture_output=True)


@contextmanager
def free_port() -> Iterator[int]:
    """A port that is reserved meanwhile."""
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind(("127.0.0.1", 0))
        yield int(holder.getsockname()[1])


def connect_to(port: int, certificates: Path, name: str, authority: str, limit_s: float) -> dict[str, Any]:
    """Settings of a session that connects with the certificate `name`, or with none."""
    return {
        "connect/endpoints": [f"tls/127.0.0.1:{port}"],
        "connect/timeout_ms": round(1e3 * limit_s),
        "connect/exit_on_failure": True,
        "transport/link/tls": {
            "enable_mtls": bool(name),
            "root_ca_certificate": str(certificates / authority),
            "connect_certificate": str(certificates / f"{name}.pem") if name else None,
            "connect_private_key": str(certificates / f"{name}.key") if name else None,
        },
    }


def insert(config: zenoh.Config, settings: dict[str, Any]) -> None:
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
