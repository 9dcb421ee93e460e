"""`birdslam evaluate lanes`: a picture of what one frame's lanes are made of, or lanes against truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.bench.lanes.hidden_cells import METHODS, HiddenReport
from birdslam.bench.lanes.paint_masks import PaintReport
from birdslam.runtime.cli.arguments import add_config, add_pipeline
from birdslam.runtime.evaluation.drive_lanes import DriveReport, evaluate_drive
from birdslam.runtime.evaluation.hidden_lanes import evaluate_hidden
from birdslam.runtime.evaluation.lanes import draw_frame_lanes
from birdslam.runtime.evaluation.still_lanes import REPORT, evaluate_paint, evaluate_stills
from birdslam.runtime.options import configuration_of

KITTI_ROAD, LINES, PAINT, LATER = "kitti-road", "lines", "paint", "later"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The drive, the frame or the kind of truth, and the pipeline."""
    parser.add_argument("drive", metavar="DRIVE|DIR", help="a KITTI directory, or a source's URI; images with --truth")
    parser.add_argument("--frame", type=int, metavar="N", help="which one; default: the last")
    text = "kitti-road: DIR holds single images image_N.png with masks ego_lane_N.png of the ego's lane; "
    text += "lines: DRIVE is a rendered one, demo:DIR, with its true lines; "
    text += "paint: DIR holds imgs/NAME.png and masks/NAME.png of lane markings, as comma10k has them; "
    text += "later: what later frames of DRIVE show of the road behind vehicles"
    parser.add_argument("--truth", choices=(KITTI_ROAD, LINES, PAINT, LATER), help=text)
    parser.add_argument(
        "--height", type=float, metavar="M", help="of the camera over the road, with --truth kitti-road"
    )
    add_config(parser)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Draws it and names the file; with truth prints the scores."""
    configuration = configuration_of(options)
    if options.truth == LINES:
        print(_text(evaluate_drive(configuration, options.drive)))
        return 0
    if options.truth == PAINT:
        print(_paint_text(evaluate_paint(configuration, Path(options.drive))))
        return 0
    if options.truth == LATER:
        print(_hidden_text(evaluate_hidden(configuration, options.drive)))
        return 0
    if options.truth is None:
        print(draw_frame_lanes(configuration, options.drive, options.frame))
        return 0
    report = evaluate_stills(configuration, Path(options.drive), options.height)
    for found in report.by_image:
        width = "no lane" if found.width_m is None else f"{found.width_m:.2f} m between {found.left} and {found.right}"
        print(f"{found.image:16} IoU {found.ego_lane_iou:.3f}, in the image {found.ego_lane_iou_image:.3f}: {width}")
    print(f"{report.images} images: mean IoU of the ego's lane {report.ego_lane_iou_mean:.3f}")
    print(Path(configuration.output) / REPORT)
    return 0


def _paint_text(report: PaintReport) -> str:
    def said(value: float | None) -> str:
        return "    -" if value is None else f"{value:5.2f}"

    out = [
        f"{found.image[:24]:24} {'night' if found.night else '':5} precision {said(found.precision)} "
        f"recall {said(found.recall)}, {found.true_px} px of paint"
        for found in report.by_image
    ]
    out.append(
        f"{report.network}: {report.images} images, at 5 px: precision {said(report.precision)}, "
        f"recall {said(report.recall)}, by night {said(report.recall_by_night)}"
    )
    return "\n".join(out)


def _hidden_text(report: HiddenReport) -> str:
    out = [f"{report.drive}: {report.cells} cells behind vehicles in {report.frames} frames that later frames saw"]
    for name in METHODS:
        road, line = report.road_iou[name], report.line_iou[name]
        said = (f"{what} {'-' if iou is None else f'{iou:.3f}'}" for what, iou in (("road", road), ("lines", line)))
        out.append(f"  {name:8} IoU of {', of '.join(said)}")
    return "\n".join(out)


def _text(report: DriveReport) -> str:
    lines, vehicles = report.lines, report.vehicles
    out = [f"{lines.drive}: {lines.frames} frames"]
    out += [
        f"  {at.ahead_m:4.0f} m ahead: error {at.error_median_m:.3f} m median, {at.error_p95_m:.3f} m p95, "
        f"bias {at.bias_m:+.3f} m, {at.within_2_sigma:.0%} within 2 sigma, {at.lines} lines"
        for at in lines.ranges
        if at.error_median_m is not None
    ]
    said = {
        "heading": (lines.heading_error_median_deg, "{:.2f} deg"),
        "width": (lines.width_error_rel, "{:+.1%}"),
        "lines found": (lines.recall, "{:.0%}"),
        "false lines a km": (lines.false_lines_per_km, "{:.1f}"),
        "frames with an ego lane": (lines.ego_lane_share, "{:.1%}"),
        "wrong": (lines.ego_lane_wrong, "{:.1%}"),
        "jitter": (lines.jitter_m, "{:.3f} m"),
        "right after": (lines.found_after_s, "{:.2f} s"),
        "vehicles in their lane": (vehicles.right, "{:.1%} of " + str(vehicles.vehicles)),
        "log loss": (vehicles.log_loss, "{:.3f}"),
        "leader named": (vehicles.leader_right, "{:.1%} of " + str(vehicles.leaders)),
        "gap's error": (vehicles.gap_error_median_m, "{:.2f} m median"),
    }
    out += [f"  {name}: {form.format(value)}" for name, (value, form) in said.items() if value is not None]
    return "\n".join(out)
