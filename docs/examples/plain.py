"""A planner with nothing but zenoh and MessagePack: python plain.py DIR/VEHICLE/hub.sock [VEHICLE]"""

import collections
import json
import sys
import threading
import time

import msgpack
import zenoh

key = f"birdslam/{sys.argv[2] if len(sys.argv) > 2 else 'car'}/v1"
config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps([f"unixsock-stream/{sys.argv[1]}"]))
config.insert_json5("connect/timeout_ms", "-1")  # the vehicle may come later, and again
config.insert_json5("listen/endpoints", "[]")
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("transport/link/protocols", '["unixsock-stream"]')
newest, arrived = collections.deque(maxlen=1), threading.Event()  # a queue of old estimates would be of no use
epoch = None


def take(sample):
    newest.append(bytes(sample.payload))
    arrived.set()


with zenoh.open(config) as session:
    subscriber = session.declare_subscriber(f"{key}/estimate", take)
    while True:
        if not arrived.wait(0.15):
            print("stale: no estimate for 150 ms", flush=True)
            continue
        arrived.clear()
        estimate = msgpack.unpackb(newest[0], max_bin_len=0, max_ext_len=0)
        age_ms = (time.monotonic_ns() - estimate["t_capture_ns"]) / 1e6
        good = estimate["valid"] and age_ms < 150
        x_m, y_m, yaw_rad = estimate["T_world_ego"]
        verdict = "good" if good else f"DO NOT USE {' '.join(estimate['status'])}"
        print(f"frame {estimate['frame_id']} at {x_m:.2f} {y_m:.2f} m, {yaw_rad:.3f} rad: {verdict}", flush=True)
        if estimate["epoch"] != epoch:  # the world began anew
            epoch, every_part = estimate["epoch"], zenoh.ConsolidationMode.NONE
            for reply in session.get(f"{key}/trajectory?last_s=30", consolidation=every_part, timeout=1.0):
                if reply.ok:
                    way = msgpack.unpackb(bytes(reply.ok.payload))
                    print(f"epoch {epoch}: {len(way['ego'])} poses so far", flush=True)
