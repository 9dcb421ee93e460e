"""`birdslam evaluate lanes`: a picture of what one frame's lanes are made of, or lanes against truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import add_config, add_pipeline
from birdslam.runtime.evaluation.lanes import draw_frame_lanes
from birdslam.runtime.evaluation.still_lanes import REPORT, evaluate_stills
from birdslam.runtime.options import configuration_of

KITTI_ROAD = "kitti-road"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The drive, the frame or the kind of truth, and the pipeline."""
    parser.add_argument("drive", metavar="DRIVE|DIR", help="a KITTI directory, or a source's URI; images with --truth")
    parser.add_argument("--frame", type=int, metavar="N", help="which one; default: the last")
    text = "kitti-road: DIR holds single images image_N.png with masks ego_lane_N.png of the ego's lane"
    parser.add_argument("--truth", choices=(KITTI_ROAD,), help=text)
    parser.add_argument("--height", type=float, metavar="M", help="of the camera over the road, with --truth kitti-road")
    add_config(parser)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Draws it and names the file; with truth prints the scores."""
    configuration = configuration_of(options)
    if options.truth != KITTI_ROAD:
        print(draw_frame_lanes(configuration, options.drive, options.frame))
        return 0
    report = evaluate_stills(configuration, Path(options.drive), options.height)
    for found in report.by_image:
        width = "no lane" if found.width_m is None else f"{found.width_m:.2f} m between {found.left} and {found.right}"
        print(f"{found.image:16} IoU {found.ego_lane_iou:.3f}, in the image {found.ego_lane_iou_image:.3f}: {width}")
    print(f"{report.images} images: mean IoU of the ego's lane {report.ego_lane_iou_mean:.3f}")
    print(Path(configuration.output) / REPORT)
    return 0
