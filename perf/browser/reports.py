"""Reports of drives as a browser shows them: in light, in dark, on a narrow screen; the slider moved; the console read.

    python -m perf reports DIR|FILE.html... --output DIR

DIR is that of a `birdslam run --output` or a `birdslam batch`: its report.html. The pictures go to --output. Status 1
where a page says something on its console, does not follow its slider, stands out to the right or has more than 15 MB
beside the film's pictures.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from birdslam.outputs.report.page import REPORT
from birdslam.perf.browser.chromium import Seen, look
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser

label = "reports of drives in headless Chromium: console, slider, size, pictures"

LOOKS = {"light": (False, (1280, 2400)), "dark": (True, (1280, 2400)), "narrow": (False, (500, 3200))}
MOST_MB = 15.0
# The slider goes to its middle; what the page shows then is left at its root element
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


def run(arguments: list[str]) -> int:
    """Prints a line a look; 1 where one is not well."""
    parser = benchmark_parser("reports", label, output="")
    parser.add_argument("pages", nargs="+", type=Path, metavar="DIR|FILE.html")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="where the pictures go")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    found = [line for page in options.pages for line in shown(page / REPORT if page.is_dir() else page, options.output)]
    for line in found:
        print(f"NOT WELL: {line}")
    return int(bool(found))


def shown(page: Path, output: Path) -> list[str]:
    """Looks at one page in all ways, prints what it shows, and gives what is not well."""
    if not page.is_file():
        raise PerfError(f"{page} is not there")
    name, size_mb = page.resolve().parent.name, page.stat().st_size / 1e6
    film_mb = sum(map(len, re.findall(r'"jpeg":"([^"]*)"', page.read_text(encoding="utf-8")))) / 1e6
    found = [f"{page}: {size_mb - film_mb:.1f} MB without its film"] if size_mb - film_mb > MOST_MB else []
    for way in LOOKS:
        seen = moved(page, output / f"{name}-{way}.png", way)
        found += [f"{page}, {way}: {line}" for line in faults(seen, way)]
        said = " ".join(f"{key} {value}" for key, value in seen.said.items() if key not in ("title", "ground", "at"))
        print(f"{name:20} {way:7} {size_mb:5.1f} MB ({film_mb:.1f} of film)  console {len(seen.console)}  {said}")
        print(f"{'':28} {seen.said.get('at', '')}")
    return found


def moved(page: Path, picture: Path, way: str) -> Seen:
    """The page with its slider in the middle."""
    dark, size_px = LOOKS[way]
    copy = page.with_name(f".looked-at-{page.name}")  # beside it, where its other files are
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", MOVED + "</body>"), encoding="utf-8")
    try:
        return look(copy.resolve().as_uri(), picture, dark=dark, size_px=size_px)
    finally:
        copy.unlink()


def faults(seen: Seen, way: str) -> Iterator[str]:
    """What a report must not show."""
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
