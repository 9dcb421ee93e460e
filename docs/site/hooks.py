"""What mkdocs asks while it builds the site: pages that lie outside of docs/, and links as the site has them."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = {  # page of the checkout -> of the site
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
WORKER = "assets/iframe-worker.js"  # the search of a site that is opened from disk; mkdocs.yml names it too
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages from outside, the pictures that they show, and the script of the search."""
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=_of_site((ROOT / source).read_text(), source)))
        for shown in re.findall(r"!\[[^\]]*\]\(([^)]+\.(?:png|jpg))\)", (ROOT / source).read_text()):
            place = posixpath.normpath(posixpath.join(posixpath.dirname(source), shown))
            if not place.startswith("docs/"):
                files.append(File.generated(config, _picture(place), abs_src_path=str(ROOT / place)))
    files.append(File.generated(config, WORKER, abs_src_path=str(Path(__file__).with_name("iframe-worker.js"))))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links of a page of docs/; those of the pages from outside are done."""
    outside = page.file.src_uri in PAGES.values()
    return markdown if outside else _of_site(markdown, f"docs/{page.file.src_uri}")


def _of_site(text: str, source: str) -> str:
    """Each link of a page at `source` in the checkout as the site has it; one to no page of it becomes its words."""

    def link(match: re.Match[str]) -> str:
        shown, words, target, anchor = match[1], match[2], match[3], match[4] or ""
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        place = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if place in PAGES:
            return f"{shown}[{words}]({PAGES[place]}{anchor})"
        if shown and not place.startswith("docs/"):
            return f"![{words}]({_picture(place)})"
        if place.startswith("docs/") and (ROOT / place).is_file():
            return f"{shown}[{words}]({place.removeprefix('docs/')}{anchor})"
        if not (ROOT / place).exists():
            return match[0]  # broken: mkdocs says so, and fails
        return words  # a file of the code, which the site does not have

    return _LINK.sub(link, text)


def _picture(place: str) -> str:
    return place.replace("/", "-")
