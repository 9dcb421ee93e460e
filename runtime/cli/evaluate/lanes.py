"""`birdslam evaluate lanes`: draws the lanes of a frame, or compares lanes with ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.bench.lanes.line_masks import text_of as line_masks_text
from birdslam.bench.lanes.paint_masks import PaintReport
from birdslam.bench.lanes.true_borders import text_of as borders_text
from birdslam.runtime.cli.arguments import add_config, add_pipeline
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.evaluation.lanes import (
    DriveReport,
    draw_frame_lanes,
    evaluate_borders,
    evaluate_drive,
    evaluate_later,
)
from birdslam.runtime.evaluation.still_lanes import REPORT, evaluate_line_masks, evaluate_paint, evaluate_stills
from birdslam.runtime.options import configuration_of

BORDERS, KITTI_ROAD, LATER, LINES, LINE_MASKS, PAINT = "borders", "kitti-road", "later", "lines", "line-masks", "paint"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the drive, the frame or the kind of truth, and the pipeline."""
    text = "KITTI directory or URI of a source; directory of images with --truth"
    parser.add_argument("drive", metavar="DRIVE|DIR", help=text)
    parser.add_argument("--frame", type=int, metavar="N", help="frame to draw; default: the last")
    text = "kitti-road: DIR has single images image_N.png with masks ego_lane_N.png of the ego lane; "
    text += "lines: DRIVE is a rendered drive with true lines, demo:DIR; "
    text += "paint: DIR has imgs/NAME.png and masks/NAME.png of lane markings, as in comma10k"
    text += "; line-masks: DIR has image_N.jpg with masks lines_N.png, as TuSimple"
    text += "; borders: DRIVE has true poses, and --borders has the borders of its lane"
    text += "; later: the lane of DRIVE ahead, with that which is found there later"
    parser.add_argument("--truth", choices=(BORDERS, KITTI_ROAD, LATER, LINES, LINE_MASKS, PAINT), help=text)
    text = "left and right border of the ego lane: distance travelled and left offset, metres (JSON)"
    parser.add_argument("--borders", type=Path, metavar="FILE", help=text)
    add_config(parser)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Draws the lanes and prints the file name, or prints the scores against the truth."""
    configuration = configuration_of(options)
    if (options.truth == BORDERS) != (options.borders is not None):
        raise ConfigurationError("--borders FILE belongs to --truth borders")
    if options.truth == BORDERS:
        print(borders_text(evaluate_borders(configuration, options.drive, options.borders)))
        return 0
    if options.truth == LATER:
        report, worst = evaluate_later(configuration, options.drive)
        print(f"{borders_text(report)}\n  worst frames: {', '.join(map(str, worst))}")
        return 0
    if options.truth == LINES:
        print(_text(evaluate_drive(configuration, options.drive)))
        return 0
    if options.truth == LINE_MASKS:
        print(line_masks_text(evaluate_line_masks(configuration, Path(options.drive))))
        return 0
    if options.truth == PAINT:
        print(_paint_text(evaluate_paint(configuration, Path(options.drive))))
        return 0
    if options.truth is None:
        print(draw_frame_lanes(configuration, options.drive, options.frame))
        return 0
    stills = evaluate_stills(configuration, Path(options.drive))
    for found in stills.by_image:
        width = "no lane" if found.width_m is None else f"{found.width_m:.2f} m between {found.left} and {found.right}"
        print(f"{found.image:16} IoU {found.ego_lane_iou:.3f}: {width}")
    print(f"{stills.images} images: mean IoU of the ego lane {stills.ego_lane_iou_mean:.3f}")
    print(Path(configuration.output) / REPORT)
    return 0


def _paint_text(report: PaintReport) -> str:
    def formatted(value: float | None) -> str:
        return "    -" if value is None else f"{value:5.2f}"

    out = [
        f"{found.image[:24]:24} {'night' if found.night else '':5} precision {formatted(found.precision)} "
        f"recall {formatted(found.recall)}, {found.true_px} true px"
        for found in report.by_image
    ]
    out.append(
        f"{report.network}: {report.images} images, at 5 px: precision {formatted(report.precision)}, "
        f"recall {formatted(report.recall)}, at night {formatted(report.recall_by_night)}"
    )
    return "\n".join(out)


def _text(report: DriveReport) -> str:
    lines, vehicles = report.lines, report.vehicles
    out = [f"{lines.drive}: {lines.frames} frames"]
    out += [
        f"  {at.ahead_m:4.0f} m ahead: error {at.error_median_m:.3f} m median, {at.error_p95_m:.3f} m p95, "
        f"{at.within_2_sigma:.0%} within 2 sigma, {at.lines} lines"
        for at in lines.ranges
        if at.error_median_m is not None
    ]
    values = {
        "width error": (lines.width_error_rel, "{:+.1%}"),
        "recall of lines": (lines.recall, "{:.0%}"),
        "wrong ego lane": (lines.ego_lane_wrong, "{:.1%}"),
        "vehicles in the true lane": (vehicles.right, "{:.1%} of " + str(vehicles.vehicles)),
    }
    out += [f"  {name}: {form.format(value)}" for name, (value, form) in values.items() if value is not None]
    return "\n".join(out)
