"""A planner that stops for a person ahead: python stop_for_people.py [VEHICLE [RUNTIME_DIR]]"""

import sys
from pathlib import Path

from birdslam.runtime.client import Planner
from birdslam.types import Estimate


def who_stops_us(estimate: Estimate) -> list[str]:
    """Who is within 1.5 m of our middle and 25 m ahead, by their place at 2 sigma, or comes near to our way soon."""
    found = []
    for person in estimate.people:
        at, sigma_m = estimate.T_world_ego.between(person.T_world_vehicle), max(person.cov[0], person.cov[4]) ** 0.5
        in_path = 0.0 < at.x_m < 25.0 and abs(at.y_m) < 1.5 + 2.0 * min(sigma_m, 1.0)
        if in_path or (person.approach is not None and person.approach.nearby and at.x_m > 0.0):
            found.append(f"{person.label} {person.vehicle}: {at.x_m:.1f} m ahead, {at.y_m:.1f} m left")
    return found


if __name__ == "__main__":
    with Planner(*sys.argv[1:2] or ["car"], *map(Path, sys.argv[2:3])) as planner:
        for reading in planner.estimates(max_age_ms=150):
            reasons = who_stops_us(reading.estimate) if reading.usable and reading.estimate else ["nothing known"]
            print(f"STOP: {'; '.join(reasons)}" if reasons else "drive on", flush=True)
