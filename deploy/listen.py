"""A planner on another machine. Needs eclipse-zenoh and msgpack, but not BirdSLAM.

python listen.py planner.json5 [VEHICLE]
"""

import sys
import time

import msgpack
import zenoh

vehicle = sys.argv[2] if len(sys.argv) > 2 else "car"
with zenoh.open(zenoh.Config.from_file(sys.argv[1])) as session:
    # RingChannel(1): a slow reader receives only the newest estimate.
    subscriber = session.declare_subscriber(f"birdslam/{vehicle}/v1/estimate", zenoh.handlers.RingChannel(1))
    for sample in subscriber:
        estimate = msgpack.unpackb(bytes(sample.payload), max_bin_len=0, max_ext_len=0)
        pose = estimate["T_world_ego"]
        age_ms = (time.time_ns() - estimate["t_utc_ns"]) / 1e6  # needs both clocks synchronised (PTP, NTP)
        is_usable = estimate["valid"] and age_ms < 200
        verdict = "good" if is_usable else "DO NOT USE"
        sys.stdout.write(f"frame {estimate['frame_id']} {pose} {age_ms:.0f} ms {verdict}\n")
        sys.stdout.flush()
