"""The search of the site opened from disk: its script in a browser. `make site` tests the build."""

from __future__ import annotations

import html
import shutil
from pathlib import Path

import pytest

from tests.chromium import chromium, look

SCRIPT = Path(__file__).resolve().parent.parent / "docs" / "site" / "iframe-worker.js"
PAGE = """<!doctype html><html><head><meta charset="utf-8"><script src="iframe-worker.js"></script></head><body><script>
const worker = new Worker("worker.js");
worker.addEventListener("message", ({data}) => document.documentElement.dataset.heard = JSON.stringify(data));
worker.postMessage({type: 0, words: ["one", "two"]});
</script></body></html>"""
WORKER = """addEventListener("message", async ({data}) => {
  postMessage({words: data.words.length, inFrame: self !== parent});
});"""


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.skipif(chromium() is None, reason="no Chromium")
def test_a_page_from_disk_has_a_worker_that_answers(tmp_path: Path) -> None:
    shutil.copy(SCRIPT, tmp_path)
    (tmp_path / "page.html").write_text(PAGE)
    (tmp_path / "worker.js").write_text(WORKER)
    seen = look((tmp_path / "page.html").as_uri(), tmp_path / "page.png")
    assert seen.console == []
    assert html.unescape(seen.said["heard"]) == '{"words":2,"inFrame":true}'
