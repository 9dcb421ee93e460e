"""A planner that stops for a person ahead: python stop_for_people.py [VEHICLE [RUNTIME_DIR]]"""

import sys
from pathlib import Path

from birdslam.runtime.client import Planner
from birdslam.types import Estimate

PATH_M, AHEAD_M = 1.5, 25.0  # to each side of the car's middle; how far it looks


def who_stops_us(estimate: Estimate) -> list[str]:
    """The people who are in our path, by their place at 2 sigma, or come into it soon."""
    found = []
    for person in estimate.people:
        at = estimate.T_world_ego.between(person.T_world_vehicle)
        sigma_m = max(person.cov[0], person.cov[4]) ** 0.5
        in_path = 0.0 < at.x_m < AHEAD_M and abs(at.y_m) < PATH_M + 2.0 * min(sigma_m, 1.0)
        if in_path or (person.approach is not None and person.approach.nearby and at.x_m > 0.0):
            found.append(f"{person.label} {person.vehicle}: {at.x_m:.1f} m ahead, {at.y_m:.1f} m left")
    return found


if __name__ == "__main__":
    runtime_dir = Path(sys.argv[2]) if len(sys.argv) > 2 else None
    with Planner(sys.argv[1] if len(sys.argv) > 1 else "car", runtime_dir) as planner:
        for reading in planner.estimates(max_age_ms=150):
            reasons = who_stops_us(reading.estimate) if reading.estimate and reading.usable else ["nothing is known"]
            print(f"STOP: {'; '.join(reasons)}" if reasons else "drive on", flush=True)
