"""The picture in docs/recording.md: a recording as docs/examples/foxglove-layout.json shows it, drawn here.

    python -m perf foxglove RECORDING [--at SECONDS] [--layout FILE] [--output FILE.jpg]

It draws the panels of the layout, each where the layout has it and with the topics and fields that the layout names,
by matplotlib: Foxglove itself is not needed and has no part in it. A name in the layout that the recording does not
have is an error.
"""

from __future__ import annotations

import json
import re
from base64 import b64decode
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Floats
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.runtime.recording.recording import JSON_CHANNELS, Recording, RecordingError
from birdslam.trajectory import inverse

label = "the layout for Foxglove, drawn of a recording"

LAYOUT = Path("docs/examples/foxglove-layout.json")
SIZE_IN = 14.0, 7.9
GAP = 0.004, 0.032  # between panels, of the width; and of the height, where their titles stand
BACKGROUND, PANEL, TEXT = "#121217", "#1e1e24", "#d8d8e0"
_PATH = re.compile(r"(/[\w/]+)((?:\.\w+|\[\d+\])*)")
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = [(i, j) for i in range(8) for j in range(i + 1, 8) if bin(i ^ j).count("1") == 1]

Series = dict[str, list[tuple[float, Any]]]  # topic -> (seconds from the first message, message)
Box = tuple[float, float, float, float]  # left, bottom, width, height, of the picture


class View(NamedTuple):
    """Where the camera of a 3D panel stands in the frame that it follows; (3,) and (3, 3), x to the right, z ahead."""

    centre: Floats
    R_view_frame: Floats
    focal: float  # of half the panel's height

    def seen(self, points: Floats) -> Floats:
        """Pieces of a line (N, 3) as (N, 2) of the panel; nan behind the camera."""
        p = (points - self.centre) @ self.R_view_frame.T
        out: Floats = np.where(p[:, 2:] > 0.5, self.focal * p[:, :2] / np.maximum(p[:, 2:], 0.5), np.nan)
        return out


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("foxglove", label, output="")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--at", type=float, default=15.0, metavar="S", help="from its beginning (default: 15)")
    parser.add_argument("--layout", type=Path, default=LAYOUT, help=f"(default: {LAYOUT})")
    parser.add_argument("--output", type=Path, default=Path("docs/foxglove.jpg"))
    options = parser.parse_args(arguments)
    try:
        layout = json.loads(options.layout.read_text(encoding="utf-8"))
        draw(layout, Recording(options.recording), options.at, options.output)
    except (OSError, json.JSONDecodeError) as error:
        raise PerfError(f"{options.layout}: {error}") from None
    except RecordingError as error:
        raise PerfError(str(error)) from None
    print(options.output)


def paths_of(panel: dict[str, Any]) -> Iterator[str]:
    """What a panel reads: topics, and fields of them as in "/latency.age_ms"."""
    yield from (path["value"] for path in panel.get("paths", ()))
    yield from (topic for topic, settings in panel.get("topics", {}).items() if settings.get("visible"))
    image = panel.get("imageMode", {})
    yield from (image[key] for key in ("imageTopic", "calibrationTopic") if key in image)
    yield from image.get("annotations", {})


def topic_and_keys(path: str) -> tuple[str, list[str | int]]:
    """ "/a/b.c[1]" as "/a/b" and ["c", 1]. Raises PerfError."""
    match = _PATH.fullmatch(path)
    if match is None:
        raise PerfError(f"{path}: no path of a message")
    keys = re.findall(r"\.(\w+)|\[(\d+)\]", match[2])
    return match[1], [name or int(index) for name, index in keys]


def value_at(message: Any, keys: Sequence[str | int]) -> Any:
    """None where it has no such field, or its list is shorter."""
    for key in keys:
        try:
            message = message[key]
        except (KeyError, IndexError):
            return None
    return message


def draw(layout: dict[str, Any], recording: Recording, at_s: float, output: Path) -> None:
    """Draws the moment `at_s` of a recording. Raises PerfError where a panel names what is not there."""
    read = {topic_and_keys(path)[0] for panel in layout["configById"].values() for path in paths_of(panel)}
    unknown = sorted(read - JSON_CHANNELS.keys())
    if unknown:
        raise PerfError(f"{', '.join(unknown)}: no channel of a recording")
    series: Series = {topic: [] for topic in (*read, "/ego")}
    first_ns: int | None = None
    for message in recording.messages(series.keys()):
        first_ns = message.t_utc_ns if first_ns is None else first_ns
        series[message.channel].append(((message.t_utc_ns - first_ns) / 1e9, msgspec.json.decode(message.data)))
    figure = Figure(figsize=SIZE_IN, dpi=100, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    for name, (left, bottom, width, height) in boxes_of(layout["layout"], (0.0, 0.03, 1.0, 0.97)):
        panel, kind = layout["configById"][name], name.partition("!")[0]
        inset = 0.03 if kind in ("Plot", "StateTransitions") else 0.0
        box = (left + GAP[0] + inset, bottom + 0.7 * inset, width - 2 * GAP[0] - inset, height - GAP[1] - 0.7 * inset)
        axes = figure.add_axes(box, facecolor=PANEL)
        axes.set_title(panel["foxglovePanelTitle"], loc="left", fontsize=9, color=TEXT, pad=3)
        axes.tick_params(colors=TEXT, labelsize=7)
        _PANELS[kind](axes, panel, series, at_s)
    said = f"{recording.path.name}, {at_s:g} s, by {LAYOUT.name}. Drawn by `python -m perf foxglove`, not by Foxglove."
    figure.text(0.005, 0.008, said, color=TEXT, fontsize=8)
    figure.savefig(output)


def boxes_of(part: Any, box: Box) -> Iterator[tuple[str, Box]]:
    """Every panel with its place; the first of two is the left or the upper one."""
    if isinstance(part, str):
        yield part, box
        return
    left, bottom, width, height = box
    share = part["splitPercentage"] / 100.0
    if part["direction"] == "row":
        yield from boxes_of(part["first"], (left, bottom, share * width, height))
        yield from boxes_of(part["second"], (left + share * width, bottom, (1.0 - share) * width, height))
    else:
        yield from boxes_of(part["first"], (left, bottom + (1.0 - share) * height, width, share * height))
        yield from boxes_of(part["second"], (left, bottom, width, (1.0 - share) * height))


def _last(messages: list[tuple[float, Any]], at_s: float) -> Any:
    """The newest message at a time; None before the first."""
    return next((message for t_s, message in reversed(messages) if t_s <= at_s), None)


def _drive(axes: Axes, panel: dict[str, Any], series: Series, at_s: float) -> None:
    """In the frame of the ego; `world` is brought there by the ego's newest pose."""
    ego = _last(series["/ego"], at_s)
    T_world_ego = _matrix(ego["pose"]) if ego else np.eye(4)
    T_ego_world = inverse(T_world_ego)
    view, half_m = _view(panel["cameraState"]), panel["layers"]["grid"]["size"] / 2.0
    steps = np.linspace(-half_m, half_m, 400)
    for line_m in np.linspace(-half_m, half_m, panel["layers"]["grid"]["divisions"] + 1):
        for points in (np.stack([steps, 0 * steps + line_m], -1), np.stack([0 * steps + line_m, steps], -1)):
            axes.plot(*view.seen(np.pad(points, ((0, 0), (0, 1)))).T, color="#ffffff", alpha=0.15, lw=0.6)
    for topic, settings in panel["topics"].items():
        if topic == "/scene":
            scene = _last(series[topic], at_s)
            for entity in scene["entities"] if scene else ():
                _entity(axes, view, T_ego_world, entity)
            continue
        since_s = at_s - settings.get("decayTime", 0.0)
        clouds = [m for t_s, m in series[topic] if since_s <= t_s <= at_s] or [_last(series[topic], at_s)]
        for cloud in filter(None, clouds):
            points = np.frombuffer(b64decode(cloud["data"]), "<f4").reshape(-1, 3)
            at = points.astype(np.float64)
            at = at if cloud["frame_id"] == "ego" else at @ T_ego_world[:3, :3].T + T_ego_world[:3, 3]
            axes.plot(*view.seen(at).T, ".", color=settings["flatColor"][:7], ms=0.6 * settings["pointSize"])
    shape = axes.get_window_extent()
    axes.set(xlim=(-shape.width / shape.height, shape.width / shape.height), ylim=(1.0, -1.0), xticks=[], yticks=[])


def _view(state: dict[str, Any]) -> View:
    """Foxglove's camera: at a distance from its target, `phi` from the vertical, `thetaOffset` about it."""
    phi, theta = np.radians(state["phi"]), -np.radians(state["thetaOffset"])
    away = np.array([np.sin(phi) * np.sin(theta), -np.sin(phi) * np.cos(theta), np.cos(phi)])
    right = np.array([np.cos(theta), np.sin(theta), 0.0])
    target = np.add(state["target"], state["targetOffset"])
    rows = np.stack([right, np.cross(-away, right), -away])
    return View(target + state["distance"] * away, rows, float(1.0 / np.tan(np.radians(state["fovy"]) / 2.0)))


def _entity(axes: Axes, view: View, T_ego_world: Floats, entity: dict[str, Any]) -> None:
    def placed(pose: dict[str, Any], points: Floats) -> Floats:
        T = T_ego_world @ _matrix(pose)
        out: Floats = view.seen(points @ T[:3, :3].T + T[:3, 3])
        return out

    for cube in entity["cubes"]:
        corners = placed(cube["pose"], _CUBE * _xyz(cube["size"]))
        for i, j in _EDGES:
            axes.plot(*corners[[i, j]].T, color=_colour(cube["color"]), lw=1.2)
    for line in entity["lines"]:
        points = np.array([_xyz(point) for point in line["points"]])
        points = np.vstack([points, points[:1]]) if line["type"] == 1 else points  # a loop
        axes.plot(*placed(line["pose"], points).T, color=_colour(line["color"]), lw=0.9)
    for text in entity["texts"]:
        (at,) = placed(text["pose"], np.zeros((1, 3)))
        if np.isfinite(at).all():
            axes.text(at[0], at[1], text["text"], color=TEXT, fontsize=7, ha="center", clip_on=True)


def _camera(axes: Axes, panel: dict[str, Any], series: Series, at_s: float) -> None:
    mode = panel["imageMode"]
    image = _last(series[mode["imageTopic"]], at_s)
    axes.set(xticks=[], yticks=[])
    if image is None:
        axes.text(0.5, 0.5, "no images", color=TEXT, ha="center", transform=axes.transAxes)
        return
    data = np.frombuffer(b64decode(image["data"]), np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if pixels is None:
        raise PerfError(f"{mode['imageTopic']}: no image that can be read")
    axes.imshow(pixels[..., ::-1])
    axes.autoscale(False)
    for topic in mode["annotations"]:
        drawn = _last(series[topic], at_s) or {"points": (), "texts": ()}
        for box in drawn["points"]:
            corners = [(p["x"], p["y"]) for p in (*box["points"], box["points"][0])]
            axes.plot(*np.array(corners).T, color=_colour(box["outline_color"]), lw=1.2)
        for text in drawn["texts"]:
            at = text["position"]
            box_style = {"facecolor": "#000000", "alpha": 0.5, "pad": 1.0, "edgecolor": "none"}
            axes.text(at["x"], at["y"], text["text"], color="w", fontsize=6, va="bottom", bbox=box_style, clip_on=True)


def _plot(axes: Axes, panel: dict[str, Any], series: Series, at_s: float) -> None:
    for path in panel["paths"]:
        topic, keys = topic_and_keys(path["value"])
        points = [(t_s, value) for t_s, message in series[topic] if (value := value_at(message, keys)) is not None]
        axes.plot(*np.array(points, dtype=np.float64).reshape(-1, 2).T, lw=0.9, label=path["label"])
    axes.axvline(at_s, color=TEXT, lw=0.6)
    axes.legend(fontsize=6, loc="upper left", framealpha=0.6, facecolor=PANEL, labelcolor=TEXT, edgecolor="none")
    axes.margins(x=0.0)


def _states(axes: Axes, panel: dict[str, Any], series: Series, at_s: float) -> None:
    colours: dict[str, str] = {}
    end_s = max((messages[-1][0] for messages in series.values() if messages), default=1.0)
    for row, path in enumerate(panel["paths"]):
        topic, keys = topic_and_keys(path["value"])
        states = [(t_s, str(value_at(message, keys))) for t_s, message in series[topic]]
        changes = [(t, v) for (t, v), (_, before) in zip(states, [(0.0, ""), *states], strict=False) if v != before]
        for (t_s, state), (until_s, _) in zip(changes, [*changes[1:], (end_s, "")], strict=True):
            colour = colours.setdefault(state, f"C{len(colours) % 10}")
            axes.broken_barh(
                [(t_s, until_s - t_s)], (row - 0.4, 0.5), facecolor="#3a3a44" if state == "None" else colour
            )
            if until_s - t_s > 0.06 * end_s:
                axes.text(t_s, row - 0.15, f" {state}", color="w", fontsize=6, va="center")
        axes.text(0.0, row - 0.42, f" {path['label']}", color=TEXT, fontsize=6, va="bottom")
    axes.axvline(at_s, color=TEXT, lw=0.6)
    axes.set(xlim=(0.0, end_s), ylim=(len(panel["paths"]) - 0.6, -0.9), yticks=[])


_PANELS = {"3D": _drive, "Image": _camera, "Plot": _plot, "StateTransitions": _states}


def _matrix(pose: dict[str, Any]) -> Floats:
    T, q = np.eye(4), pose["orientation"]
    T[:3, :3] = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix()
    T[:3, 3] = _xyz(pose["position"])
    return T


def _xyz(vector: dict[str, float]) -> Floats:
    return np.array([vector["x"], vector["y"], vector["z"]])


def _colour(color: dict[str, float]) -> tuple[float, float, float]:
    return color["r"], color["g"], color["b"]
