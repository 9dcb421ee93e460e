"""The car says how fast it is, with nothing but zenoh and MessagePack: lines of speed_mps [yaw_rate_radps] come in.

python car_speed.py DIR/VEHICLE/hub.sock [VEHICLE]    on the vehicle's computer, as its own user
python car_speed.py car.json5 [VEHICLE]               from elsewhere, by the car's certificate (docs/deployment.md)
"""

import json
import sys
import time

import msgpack
import zenoh

where, vehicle = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "car"
here = where.endswith(".sock")
config = zenoh.Config() if here else zenoh.Config.from_file(where)
if here:
    config.insert_json5("connect/endpoints", json.dumps([f"unixsock-stream/{where}"]))
    config.insert_json5("connect/timeout_ms", "-1")  # the vehicle may come later, and again
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/link/protocols", '["unixsock-stream"]')
with zenoh.open(config) as session:
    speed = session.declare_publisher(f"birdslam/{vehicle}/v1/speed", priority=zenoh.Priority.REAL_TIME, express=True)
    for line in sys.stdin:
        now_ns = time.monotonic_ns() if here else 0  # 0: another computer's clock, the reading bears when it came
        speed_mps, *turn = map(float, line.split())
        reading = {"t_ns": now_ns, "speed_mps": speed_mps, "sigma_mps": 0.05}
        if turn:
            reading |= {"yaw_rate_radps": turn[0], "yaw_rate_sigma_radps": 0.01}
        speed.put(msgpack.packb(reading))
