"""1-sigma of box edges by detector family, measured on KITTI tracking (docs/networks.md).

A mean offset of an edge is part of its sigma, since boxes are not corrected.
"""

from __future__ import annotations

from typing import Literal

from birdslam.perception.decoding.detection import EdgeSigma

FAMILIES: dict[str, EdgeSigma] = {
    # Two-stage networks of high resolution: RRC, sixteen sequences
    "rrc": EdgeSigma((0.025, 0.025, 0.02, 0.0275), 0.75),
    # One-stage networks: YOLOX-nano on 0002 and 0005
    "yolox": EdgeSigma((0.04, 0.04, 0.0375, 0.0475), 0.5),
    # Single-shot networks of small input: vehicle-detection-adas-0002 on 0002 and 0005
    "ssd": EdgeSigma((0.0875, 0.0875, 0.0525, 0.085), 0.25),
}
UNKNOWN = FAMILIES["ssd"]  # of an unmeasured family: the largest measured sigma

# "configured": `slam.frontend.localisation.sigma_box_rel` and `sigma_box_px`
Family = Literal["unknown", "rrc", "yolox", "ssd", "configured"]


def sigma_of(family: Family) -> EdgeSigma | None:
    """1-sigma of a family's edges; None: the configuration's. Raises ValueError for an unknown name."""
    if family == "configured":
        return None
    if family != "unknown" and family not in FAMILIES:
        raise ValueError(
            f"unknown detector family {family!r}; expected one of {', '.join((*FAMILIES, 'unknown', 'configured'))}"
        )
    return FAMILIES.get(family, UNKNOWN)
