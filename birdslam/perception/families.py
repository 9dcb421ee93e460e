"""How sure the edges of boxes are, by the family of their detector.

Measured by `python -m perf box_edges` on KITTI tracking, as docs/networks.md says; where a family draws an edge beside
the vehicle's on average, that is in its sigma: boxes come in as they are.
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
UNKNOWN = FAMILIES["ssd"]  # of a family that was not measured: as the widest that was

# "configured": `slam.frontend.localisation.sigma_box_rel` and `sigma_box_px`
Family = Literal["unknown", "rrc", "yolox", "ssd", "configured"]


def sigma_of(family: Family) -> EdgeSigma | None:
    """Of a family's boxes; None: the configuration's. Raises ValueError for another name."""
    if family == "configured":
        return None
    if family != "unknown" and family not in FAMILIES:
        raise ValueError(
            f"no family of detectors {family!r}; there are {', '.join((*FAMILIES, 'unknown', 'configured'))}"
        )
    return FAMILIES.get(family, UNKNOWN)
