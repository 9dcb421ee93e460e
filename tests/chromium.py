"""Opens a page in headless Chromium: console output, data of scripts, and a screenshot."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

LIMIT_S = 300.0
VIRTUAL_MS = 8000  # of the page's own clock, which runs as fast as there is work
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@dataclass(frozen=True)
class Seen:
    """What came of it: lines of the console, and the root element's data-* as the page leaves them."""

    console: list[str]
    said: dict[str, str]
    dom: str


def chromium() -> str | None:
    """Debian's program, where it is installed."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def look(
    url: str,
    picture: Path,
    *,
    dark: bool = False,
    size_px: tuple[int, int] = (1280, 900),
    virtual_ms: int | None = VIRTUAL_MS,
    more: tuple[str, ...] = (),
) -> Seen:
    """Opens a page and takes its picture (PNG). Raises RuntimeError where there is no browser, or it fails."""
    program = chromium()
    if program is None:
        raise RuntimeError("no Chromium (Debian: apt install chromium)")
    scheme, size = f"--blink-settings=preferredColorScheme={int(not dark)}", "{},{}".format(*size_px)
    command = [
        *(program, "--headless", "--no-sandbox", "--enable-logging=stderr", "--hide-scrollbars", "--dump-dom"),
        *(scheme, f"--window-size={size}", f"--screenshot={picture}"),
        *((f"--virtual-time-budget={virtual_ms}",) if virtual_ms else ()),
        *(more or ("--disable-gpu",)),
        url,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode or not picture.is_file():
        raise RuntimeError(f"{url}: {done.stderr[-1000:]}")
    root = re.search("<html[^>]*>", done.stdout)
    said = dict(re.findall(r'data-([\w-]+)="([^"]*)"', root[0])) if root else {}
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return Seen(console, {name: html.unescape(value) for name, value in said.items()}, done.stdout)
