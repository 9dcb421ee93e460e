"""A ROS 2 node that says what BirdSLAM says: python ros2_node.py VEHICLE CAMERA.toml

Untested: ROS 2 was not at hand. vision_msgs must be installed.
"""

import sys
from pathlib import Path

import rclpy

from birdslam import load_camera
from birdslam.ros.messages import RosMessages, rclpy_message, t_of
from birdslam.runtime.client import Planner

vehicle, camera_file = sys.argv[1:]
rclpy.init()
node, publishers = rclpy.create_node("birdslam"), {}
messages = RosMessages(rclpy_message, load_camera(Path(camera_file)), vehicle)
with Planner(vehicle) as planner:
    for reading in planner.estimates(max_age_ms=150):
        estimate = reading.estimate if reading.on_time else None
        for topic, message in messages.of_estimate(estimate, t_of(estimate, live=True)) if estimate else ():
            if topic not in publishers:
                publishers[topic] = node.create_publisher(type(message), topic, 10)
            publishers[topic].publish(message)
