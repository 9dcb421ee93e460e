"""Opens reports in headless Chromium, in light, dark and narrow layouts, and moves the slider."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tests.chromium import Seen, look

LOOKS = {"light": (False, (1280, 2400)), "dark": (True, (1280, 2400)), "narrow": (False, (500, 3200))}
# Moves the slider to its middle and stores the state of the page in data attributes of the root element
MOVED = """<script>(() => {
  const root = document.documentElement.dataset;
  const slider = document.getElementById("at"), picture = document.getElementById("picture");
  if (slider) {
    const map = document.getElementById("map"), before = [picture ? picture.src : "", document.title];
    root.from = `${map.data.at(-1).x[0]},${map.data.at(-1).y[0]}`;
    slider.value = String(Math.round(Number(slider.max) / 2));
    slider.dispatchEvent(new Event("input"));
    root.to = `${map.data.at(-1).x[0]},${map.data.at(-1).y[0]}`;
    root.at = document.getElementById("words").textContent;
    root.film = picture ? String(picture.src !== before[0]) : "none";
    root.plots = String(document.querySelectorAll(".plot .main-svg").length);
    const earth = document.getElementById("earth");
    if (earth) root.earth = `${earth.data.at(-1).y[0]},${earth.data.at(-1).x[0]}`;
  }
  root.over = String(document.documentElement.scrollWidth - innerWidth);
  root.ground = getComputedStyle(document.body).backgroundColor;
  root.title = document.title;
})()</script>"""


def moved(page: Path, picture: Path, way: str) -> Seen:
    """Opens the page and moves the slider to its middle."""
    dark, size_px = LOOKS[way]
    copy = page.with_name(f".looked-at-{page.name}")  # beside it, where its other files are
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", MOVED + "</body>"), encoding="utf-8")
    try:
        return look(copy.resolve().as_uri(), picture, dark=dark, size_px=size_px)
    finally:
        copy.unlink()


def faults(seen: Seen, way: str) -> Iterator[str]:
    """Yields the faults of a report."""
    yield from seen.console
    said = seen.said
    if "to" in said and (said.get("ready") != "yes" or said["from"] == said["to"]):
        yield f"the slider moves nothing: from {said['from']} to {said['to']}"
    if said.get("film") == "false":
        yield "the film does not follow the slider"
    if "over" not in said:
        yield "is no page that ends as one: nothing could be asked of it"
        return
    if float(said["over"]) > 0.0:
        yield f"stands out to the right by {said['over']} px"
    bright = sum(int(part) for part in said["ground"].removeprefix("rgb(").rstrip(")").split(",")[:3])
    if (bright < 3 * 64) != LOOKS[way][0]:
        yield f"the ground is {said['ground']}"
