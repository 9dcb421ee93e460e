"""A planner on the vehicle's computer, with BirdSLAM's own client: python planner.py [VEHICLE [RUNTIME_DIR]]"""

import sys
from pathlib import Path

from birdslam.runtime.client import Planner

vehicle = sys.argv[1] if len(sys.argv) > 1 else "car"
runtime_dir = Path(sys.argv[2]) if len(sys.argv) > 2 else None
epoch = None
with Planner(vehicle, runtime_dir) as planner:
    for reading in planner.estimates(max_age_ms=150):  # at the latest each 150 ms, whatever happens
        estimate = reading.estimate
        if estimate is None or not reading.usable:
            print(f"slow down: alive {reading.alive}, on time {reading.on_time}, valid {reading.valid}", flush=True)
            continue
        if estimate.epoch != epoch:  # the world began anew: forget all places of the one before
            epoch, road = estimate.epoch, planner.map()
            print(f"epoch {epoch}: {len(road.lanes_m) if road else 0} lane points so far", flush=True)
        print(f"frame {estimate.frame_id}: {reading.age_ms:.0f} ms old, {reading.left_ms:.0f} ms to spare", flush=True)
        for car in estimate.vehicles:
            ahead = estimate.T_world_ego.between(car.T_world_vehicle)
            print(f"  {car.label} {car.vehicle}: {ahead.x_m:.1f} m ahead, {ahead.y_m:.1f} m left", flush=True)
