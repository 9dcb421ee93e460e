"""The keys that a TOML file and `--set` know, each with its meaning.

A word in capitals stands for any name. Each key is a field of the typed configuration, which has its type, default and
limits; all other fields are constants beside the code that reads them.
"""

from __future__ import annotations

from typing import NamedTuple


class Group(NamedTuple):
    """Keys that belong together, with the meaning of each."""

    title: str
    about: str
    meanings: dict[str, str]


GROUPS = (
    Group(
        "Images",
        "Options of `birdslam run`: `--source`, `--rate`, `--stride`, `--topic`, `--camera-info-topic`.",
        {
            "source.uri": "Source of the images: video:FILE, v4l2:/dev/videoN, ... See [sources.md](sources.md)",
            "source.rate": 'Images per second; none: the time stamps of the source; "max": every image, as fast as '
            "possible",
            "source.stride": "Read every N-th image of a recording",
            "source.frames": "Stop after this many images; none: at the end of the source",
            "source.loop": "Repeat a recording",
            "source.topics.image": 'Image topic of a ROS bag; "": the only one',
            "source.topics.camera_info": 'CameraInfo topic of a ROS bag; "": the one beside the image topic',
            "source.camera_timeout_s": "Time without an image after which a camera or stream has failed",
        },
    ),
    Group(
        "Camera",
        '`camera = "FILE.toml"`, or `--camera`, names a camera file as `birdslam calibrate` writes it; a table '
        "`[camera]` states the numbers in place. Without either the recording must contain its camera.",
        {
            "camera.width_px": "Width of an image",
            "camera.height_px": "Height of an image",
            "camera.fx_px": "Horizontal focal length",
            "camera.fy_px": "Vertical focal length",
            "camera.cx_px": "Horizontal position of the principal point",
            "camera.cy_px": "Vertical position of the principal point",
            "camera.height_m": "Height of the camera above the road; all lengths scale with it",
            "camera.pitch_rad": "Pitch, positive if the camera looks down",
            "camera.roll_rad": "Roll, positive if the right side is lower",
            "camera.tilt_sigma_rad": "1-sigma of pitch and roll",
            "camera.distortion": "OpenCV distortion k1, k2, p1, p2[, k3[, k4, k5, k6]]; none: undistorted images",
            "camera.readout_s": "Readout time from the first to the last row; 0: global shutter",
            "camera.scale_sigma_rel": "1-sigma of all lengths due to height and focal length, a fraction; 0: measured",
            "camera.fisheye": "The distortion is k1, k2, k3, k4 of an equidistant fisheye lens",
            "camera_sha256": 'SHA-256 that the camera file must have; "": any',
            "slam.frontend.odometry.start.camera_ahead_m": "Distance of the camera ahead of the rear axle",
        },
    ),
    Group(
        "Networks",
        "`--model NAME` or `--model ROLE=FILE.onnx` sets most of them; ROLE is detector, segmenter, depth, multitask "
        "or pointnet. See [networks.md](networks.md).",
        {
            "models.ROLE.path": "Network: an ONNX file, or the name of an installed one",
            "models.ROLE.manifest": 'Manifest: a TOML file or a shipped manifest; "": FILE.toml beside FILE.onnx',
            "models.ROLE.every": "Run on every N-th image; none: as in the manifest",
            "models.ROLE.threads": "Number of threads; none: as in the manifest",
            "models.ROLE.provider": "Execution provider of this network; none: perceive.provider",
            "models.shipped": "Use the shipped network for roles without another network",
            "models.bodies": "Use depth, length and yaw of the multi-task network for boxes of another detector",
            "models.completion": "Complete lanes behind occlusions (ENet)",
            "source.detections": 'Boxes that replace the detector: MOT, KITTI tracking or COCO results; "": none',
            "source.detector": "Family of that detector, which sets the sigma of its box edges; configured: "
            "slam.frontend.localisation.sigma_box_rel and sigma_box_px",
            "runtime.models_dir": 'Folder of installed networks; "": in the folder of the user',
        },
    ),
    Group(
        "Method",
        "[method.md](method.md) lists what the paper's method has.",
        {"method": "Our method, or the paper's choices for ego, vehicles and graph (`birdslam.paper`)"},
    ),
    Group(
        "Results",
        "See [recording.md](recording.md). Options: `--output`, `--record`, `--record-images`, `--smooth`, `--video`, "
        "`--map`, `--map-only`, `--gnss`, `--gnss-offset`.",
        {
            "output": "Folder of the results",
            "results.smooth": "Also write smoothed trajectories: tracks/ID.final.tum.txt, ego.final.*",
            "results.video": 'Video of images and bird\'s-eye view, FILE.mp4; "": none',
            "results.map": 'Map in which the drive is localized and which it extends or creates; "": none. See '
            "[maps.md](maps.md)",
            "results.gnss": "GNSS fixes: a file (CSV, NMEA, GPX), topic:/NAME of a ROS bag, or a receiver "
            '/dev/TTY[@BAUD]; "": none',
            "results.gnss_offset_s": "Time from the first fix of the file to the first image; none: by the clocks, "
            "or where these are unrelated by the shape of the drive",
            "results.map_only": 'Map in which the drive is localized without a change to it; "": none',
            "recording.file": 'Recording: FILE.mcap, which must not exist, or a folder for a new file; "": none',
            "recording.images": "Also record the images, as JPEG",
            "recording.jpeg_quality": "Quality of these images",
            "recording.flush_ms": "Interval of writing: the most that a killed process loses",
            "recording.sync": "Write to the disk itself at this interval, so that a power cut loses no more",
        },
    ),
    Group(
        "Vehicle speed and external odometry",
        "See [sources.md](sources.md). Options: `--speed`, `--speed-topic`, `--odometry`.",
        {
            "source.speed": 'File of the vehicle\'s speed: time in s, speed in m/s; "": none',
            "source.topics.speed": "Speed topic of a ROS bag: TwistStamped, TwistWithCovarianceStamped or Odometry; "
            '"": none',
            "slam.frontend.odometry.road.car.sigma_factor_rel": "1-sigma of the scale factor of the speed, which is "
            "estimated",
            "slam.frontend.odometry.road.car.sigma_delay_s": "1-sigma of the delay of the speed, which is estimated",
            "source.odometry": "Trajectory that replaces the visual odometry: TUM lines or KITTI rows, in metres; "
            '"": none',
            "slam.frontend.external.ego": "Its poses are of the ego (x forward); false: of the camera (z forward)",
            "slam.frontend.external.sigma_scale_rel": "1-sigma of its scale",
            "slam.frontend.external.sigma_direction_rad": "1-sigma of its direction of travel",
            "slam.frontend.external.sigma_yaw_rad": "1-sigma of its rotation between two images",
            "source.topics.truth": "Ground truth topic for `evaluate odometry`: nav_msgs/Odometry or "
            'sensor_msgs/NavSatFix; "": none',
        },
    ),
    Group(
        "Rates and budgets",
        "See [deployment.md](deployment.md). ROLE is detector, segmenter, depth or multitask.",
        {
            "perceive.deadline_ms": "Time after capture at which an image stops waiting for networks; none: three "
            'quarters of the period; at rate "max" it waits for all',
            "perceive.schedule.ROLE.hz": "Rate of a network; none: as in the manifest, or as the computer allows",
            "perceive.schedule.ROLE.every": "Run the network on every N-th image; not together with hz",
            "perceive.schedule.ROLE.awaited": "An image waits for this network",
            "perceive.schedule.lanes.hz": "Rate of lane estimation",
            "perceive.schedule.lanes.every": "Estimate lanes on every N-th image; not together with hz",
            "perceive.looks.adaptive": "Run networks as often as the computer allows; false: as in their manifests",
            "perceive.looks.least_hz": "Lowest rate of the networks",
            "perceive.provider": "Execution provider: cpu, openvino, cuda, tensorrt, or auto, the fastest one with the "
            'same results; at rate "max" auto is cpu. See [networks.md](networks.md)',
            "perceive.opencv_threads": "Number of threads of OpenCV",
            "budgets.end_to_end_ms": "Highest age of an estimate at the planner, from capture on",
            "budgets.percentile": "Percentage of images for which this and the budgets of the parts must hold",
            "budgets.capture_ms": "Budget of capture",
            "budgets.capture_to_perceive_ms": "Budget from capture to perceive",
            "budgets.perceive_ms": "Budget of perceive, with the wait before it",
            "budgets.perceive_to_optimize_ms": "Budget from perceive to optimize",
            "budgets.optimize_ms": "Budget of optimize, with the wait before it",
            "budgets.optimize_to_planner_ms": "Budget from optimize to the planner; all parts together must not exceed "
            "end_to_end_ms",
            "degradation.enabled": "Let perceive do less work if it is late",
            "degradation.coast_max_ms": "Longest time of predicted frames before they are invalid",
        },
    ),
    Group(
        "Reported vehicles",
        "",
        {
            "vehicle": "Name of the vehicle on the bus",
            "slam.frontend.tracking.birth_score": "Lowest detector score of a new road user",
            "slam.frontend.tracking.confirm_hits": "Number of detections before a road user is reported",
            "slam.graph.forget_s": "Time for which a vehicle out of sight is reported",
            "slam.graph.max_vehicles": "Highest number of vehicles",
            "slam.frontend.localisation.max_range_m": "Highest distance of vehicles",
            "slam.frontend.localisation.vehicles.NAME.length_m": "Mean length of vehicles of a class; a file lists all "
            "classes that count as vehicles",
            "slam.frontend.localisation.vehicles.NAME.width_m": "Mean width",
            "slam.frontend.localisation.vehicles.NAME.height_m": "Mean height",
            "slam.frontend.localisation.vehicles.NAME.sigma_length_rel": "1-sigma of the lengths, relative",
            "slam.frontend.localisation.vehicles.NAME.sigma_width_rel": "1-sigma of the widths in images, relative",
            "slam.frontend.localisation.vehicles.NAME.sigma_height_rel": "1-sigma of the heights, relative",
            "atlas.vehicles": "Number of vehicles whose paths a planner can query",
            "atlas.vehicle_poses": "Number of newest poses of each path",
        },
    ),
    Group(
        "Processes and real time",
        "See [deployment.md](deployment.md). NODE is capture, perceive or optimize.",
        {
            "runtime.runtime_dir": 'Folder of sockets, locks and vitals; "": in the folder of the user',
            "runtime.ready_timeout_s": "Longest start of a node",
            "runtime.watchdog_ms": "Time without a sign of life after which a node has stalled; none: 2 s, at rate "
            '"max" a minute',
            "runtime.restart": 'Restart a node that died or stalled; none: "always", but "never" at rate "max", which '
            "must not lose an image",
            "runtime.restarts_max": "Number of restarts before the run ends",
            "runtime.restart_window_s": "Time within which these restarts count",
            "runtime.spares": "Keep a loaded spare process of each node",
            "realtime.fifo": 'SCHED_FIFO; "auto": all nodes with a live camera, else capture and optimize, and the '
            "frames of perceive before its networks",
            "realtime.lock_memory": 'Lock the memory of the nodes in RAM; "auto": with a live camera',
            "realtime.NODE.priority": "Priority of a node under SCHED_FIFO",
            "realtime.NODE.cpus": "Cores of a node; none: all",
        },
    ),
    Group(
        "ROS 2, live",
        "See [ros.md](ros.md). For `birdslam ros` and for a source `ros:/TOPIC`.",
        {
            "ros.router": "Address of the router of rmw_zenoh",
            "ros.domain": "ROS domain; none: the variable ROS_DOMAIN_ID, else 0",
            "ros.namespace": 'Namespace of our topics and frames; "": none',
            "ros.release": "Release of ROS 2 of the other nodes; jazzy: any since Jazzy",
        },
    ),
    Group(
        "Fleet",
        "See [deployment.md](deployment.md). `[fleet]` belongs to a vehicle or listener, `[router]` to "
        "`birdslam router`.",
        {
            "fleet.router": 'Address of the router, tls/HOST:PORT; "": none',
            "fleet.ca": "Certificate of the fleet's authority, FILE.pem",
            "fleet.certificate": "Certificate of this computer, FILE.pem",
            "fleet.key": "Private key, FILE.pem",
            "fleet.estimates_hz": "Highest rate of the estimates that are sent; none: all",
            "fleet.vehicles": "Vehicles that a listener lists before their first message",
            "router.listen": "Address that vehicles and listeners connect to",
            "router.ca": "Certificate of the fleet's authority, FILE.pem",
            "router.certificate": "Certificate of the router, FILE.pem",
            "router.key": "Private key, FILE.pem",
            "router.vehicles": 'Vehicles; each has a certificate named "vehicle NAME" and writes its own keys only',
            "router.listeners": "Common names of the certificates that may read all vehicles",
            "router.messages_hz": "Highest rate of messages of a vehicle on one key; others are dropped",
        },
    ),
)

KEYS = {key: meaning for group in GROUPS for key, meaning in group.meanings.items()}
