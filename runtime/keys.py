"""What a user may change: every key that a TOML file and `--set` know, with the question that it answers.

In the order in which a user meets them. A word in capitals stands for any name in its place. Each is a field of the
typed configuration, which has its type, default and limits; the other fields are constants of the method and its
processes, which stand beside the code that reads them.
"""

from __future__ import annotations

from typing import NamedTuple


class Group(NamedTuple):
    """Keys that are thought of together; the question of each."""

    title: str
    about: str
    questions: dict[str, str]


GROUPS = (
    Group(
        "Where images come from",
        "Most of these have options of `birdslam run`: `--source`, `--rate`, `--stride`, `--topic`, "
        "`--camera-info-topic`.",
        {
            "source.uri": "Where do images come from? As [sources.md](sources.md) lists: video:FILE, "
            "v4l2:/dev/videoN, ...",
            "source.rate": 'How many images a second? none: by the source\'s own time stamps; "max": each, without '
            "loss, "
            "as fast as can be",
            "source.stride": "One image of a recording in how many?",
            "source.frames": "After how many images does the run end? none: with the source",
            "source.loop": "Does a recording restart at its end?",
            "source.topics.image": 'Which topic of a ROS bag has the images? "": the only one that is there',
            "source.topics.camera_info": "Which has the camera's numbers? \"\": the one beside the images' topic, or "
            "the only one",
            "source.camera_timeout_s": "When has a camera or stream that delivers nothing failed?",
        },
    ),
    Group(
        "The camera",
        '`camera = "FILE.toml"`, or `--camera`, names a camera file as `birdslam calibrate` writes it; a table '
        "`[camera]` "
        "states the numbers in place. Without either the recording has to know its camera.",
        {
            "camera.width_px": "How wide is an image?",
            "camera.height_px": "How high is an image?",
            "camera.fx_px": "What is the focal length, across?",
            "camera.fy_px": "What is the focal length down the image?",
            "camera.cx_px": "Where is the principal point, across?",
            "camera.cy_px": "Where is the principal point down the image?",
            "camera.height_m": "How high over the road is the camera? All metres come from this, or from the car's own "
            "speed",
            "camera.pitch_rad": "By how much does it look down?",
            "camera.roll_rad": "By how much is it turned right side down?",
            "camera.tilt_sigma_rad": "How sure are these two angles (1-sigma)? As well as a bracket is screwed on",
            "camera.distortion": "What does the lens bend? OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; none: the "
            "images are undistorted",
            "camera.readout_s": "How long does it take to read an image, from its first row to its last? 0: all rows "
            "at once (global shutter)",
            "camera.scale_sigma_rel": "How sure are height and focal length, and so all lengths together (1-sigma, a "
            "fraction)? 0: they were measured",
            "camera.fisheye": "Are those numbers k1, k2, k3, k4 of a fisheye lens (equidistant)?",
            "camera_sha256": 'Which camera file must it be, and no other? Its SHA-256; "": any',
            "slam.frontend.odometry.start.camera_ahead_m": "How far ahead of the rear axle is the camera?",
        },
    ),
    Group(
        "Networks",
        "`--model NAME` or `--model ROLE=FILE.onnx` does for most; ROLE is detector, segmenter, depth, multitask or "
        "pointnet. See [networks.md](networks.md).",
        {
            "models.ROLE.path": "Which network? An ONNX file, or the name of an installed one",
            "models.ROLE.manifest": 'How is it read? A TOML file, or the name of a shipped manifest; "": FILE.toml '
            "beside "
            "FILE.onnx",
            "models.ROLE.every": "On one image in how many does it run? none: as its manifest says",
            "models.ROLE.threads": "On how many threads? none: as its manifest says",
            "models.ROLE.provider": "What computes this one? As perceive.provider; none: as that says",
            "models.shipped": "Does the package's own network run where no other finds vehicles or the road?",
            "models.bodies": "Does the multi-task network look beside another detector, for the depth, length and yaw "
            "of the vehicles that this one finds?",
            "models.completion": "Are lanes completed where something hid the road (ENet)?",
            "source.detections": "Which file has another detector's boxes, in place of a network's? MOT, KITTI "
            'tracking or COCO results; "": none',
            "source.detector": "Which family is that detector of, by which its boxes' edges are more or less sure? "
            "configured: by slam.frontend.localisation.sigma_box_rel and sigma_box_px",
            "runtime.models_dir": 'Where do installed networks lie? "": in the user\'s own folder',
        },
    ),
    Group(
        "The method",
        "[method.md](method.md) says what the paper's has and has not.",
        {
            "method": "Ours, or the paper's own choices for the ego, the places of cars and the graph "
            "(`birdslam.paper`)?"
        },
    ),
    Group(
        "What is written",
        "See [recording.md](recording.md). Options: `--output`, `--record`, `--record-images`, `--smooth`, `--video`, "
        "`--map`, `--map-only`, `--gnss`.",
        {
            "output": "Into which folder do results go?",
            "results.smooth": "Are final trajectories wanted too, smoothed over the whole drive? "
            "tracks/ID.final.tum.txt, "
            "ego.final.*",
            "results.video": 'Is a video wanted, and where? FILE.mp4, of images and bird\'s-eye view; "": none',
            "results.map": 'Which map of places is the drive localised in, and makes longer or begins? FILE; "": none. '
            "See [maps.md](maps.md)",
            "results.gnss": "Where do GNSS fixes come from? A file (CSV, NMEA, GPX), topic:/NAME of a ROS bag, or a "
            'receiver /dev/TTY[@BAUD]; "": from nowhere',
            "results.map_only": 'Which map is it localised in without a change to it? FILE; "": none',
            "recording.file": "Is the drive recorded, and where? FILE.mcap, which must not exist yet; a directory: a "
            "new "
            'file in it, named by the time; "": no',
            "recording.images": "Does the recording have the images too, as JPEG?",
            "recording.jpeg_quality": "Of which quality are these?",
            "recording.flush_ms": "How much of the drive may a kill cost?",
            "recording.sync": "Does a power cut cost no more than that? Each time to the disk itself, then",
        },
    ),
    Group(
        "The car's own speed, or odometry",
        "See [sources.md](sources.md). Options: `--speed`, `--speed-topic`, `--odometry`.",
        {
            "source.speed": 'Which file has the car\'s own speed? Lines of time in s, speed in m/s; "": none',
            "source.topics.speed": "Which topic of a ROS bag has it? TwistStamped, TwistWithCovarianceStamped or "
            'Odometry; "": none',
            "slam.frontend.odometry.road.car.sigma_factor_rel": "By how much may a speedometer be off (1-sigma)? It is "
            "learned",
            "slam.frontend.odometry.road.car.sigma_delay_s": "How late may its readings be (1-sigma)? That is learned "
            "too",
            "source.odometry": "Which file has another odometry, in place of the images'? TUM lines or KITTI rows, in "
            'metres; "": none',
            "slam.frontend.external.ego": "Are its poses the ego's on the road (x forward)? false: the camera's (z "
            "forward)",
            "slam.frontend.external.sigma_scale_rel": "How far off are its metres (1-sigma)?",
            "slam.frontend.external.sigma_direction_rad": "How far off is its direction of travel?",
            "slam.frontend.external.sigma_yaw_rad": "How far off is its turn between two images?",
            "slam.frontend.external.longest_gap_s": "Over how long a gap between two of its poses is there still one "
            "between them?",
            "source.topics.truth": "For `evaluate odometry`: which topic has the true poses? nav_msgs/Odometry or "
            'sensor_msgs/NavSatFix; "": none',
        },
    ),
    Group(
        "Rates and budgets",
        "See [deployment.md](deployment.md). ROLE is detector, segmenter, depth or multitask.",
        {
            "perceive.deadline_ms": "How long after its capture does an image wait for networks? none: three quarters "
            "of "
            'the time to the next one; at rate "max" to their end',
            "perceive.schedule.ROLE.hz": "How often a second does a network look? none: as its manifest says, or as "
            "the "
            "computer can",
            "perceive.schedule.ROLE.every": "On one image in how many does it look? Not beside hz",
            "perceive.schedule.ROLE.awaited": "Does an image wait for that network?",
            "perceive.schedule.lanes.hz": "How often a second are lanes made out?",
            "perceive.schedule.lanes.every": "On one image in how many are they made out? In place of hz",
            "perceive.looks.adaptive": "Do networks look as often as the computer can? false: as their manifests say",
            "perceive.looks.least_hz": "How often a second do they look at the least?",
            "perceive.provider": "What computes the networks: cpu, openvino, cuda, tensorrt, or auto, what is fastest "
            'here and gives the same? At rate "max" auto is cpu, so that a run repeats. See [networks.md](networks.md)',
            "perceive.opencv_threads": "How many threads has OpenCV?",
            "budgets.end_to_end_ms": "How old may an estimate be when the planner has it, from its image's capture on?",
            "budgets.percentile": "Of how many images in a hundred must this hold, and the limits of the parts?",
            "budgets.capture_ms": "How long may capture take?",
            "budgets.capture_to_perceive_ms": "How long may an image take from there to perceive?",
            "budgets.perceive_ms": "How long may perceive take, with the wait before it?",
            "budgets.perceive_to_optimize_ms": "How long may measurements take from there to optimize?",
            "budgets.optimize_ms": "How long may optimize take, with the wait before it?",
            "budgets.optimize_to_planner_ms": "How long may an estimate take to the planner? All parts together take "
            "no "
            "longer than end_to_end_ms",
            "degradation.enabled": "Does perceive do less where it comes late?",
            "degradation.coast_max_ms": "How long may it go without a look, until what comes is invalid?",
        },
    ),
    Group(
        "What is reported",
        "",
        {
            "vehicle": "What is this car called on the bus?",
            "slam.frontend.tracking.birth_score": "How sure must a detector be for a new vehicle?",
            "slam.frontend.tracking.confirm_hits": "How often must a vehicle be seen to be reported?",
            "slam.graph.forget_s": "For how long is one reported that is out of sight?",
            "slam.graph.max_vehicles": "How many vehicles are reported at once?",
            "slam.frontend.localisation.max_range_m": "To which distance are vehicles placed?",
            "slam.frontend.localisation.vehicles.NAME.length_m": "How long are vehicles of a class in this country? A "
            "class that the table does not name is none; a file states all that it wants",
            "slam.frontend.localisation.vehicles.NAME.width_m": "How wide are they?",
            "slam.frontend.localisation.vehicles.NAME.height_m": "How high are they?",
            "slam.frontend.localisation.vehicles.NAME.sigma_length_rel": "By how much do their lengths differ "
            "(1-sigma)?",
            "slam.frontend.localisation.vehicles.NAME.sigma_width_rel": "By how much do their widths differ, as "
            "images show them?",
            "slam.frontend.localisation.vehicles.NAME.sigma_height_rel": "By how much do their heights differ?",
            "atlas.vehicles": "Of how many vehicles does a planner find the path so far?",
            "atlas.vehicle_poses": "How many poses of each does it find, the newest?",
        },
    ),
    Group(
        "Processes and real time",
        "See [deployment.md](deployment.md). NODE is capture, perceive or optimize.",
        {
            "runtime.runtime_dir": 'Where are sockets, locks and vitals? "": in the user\'s own folder',
            "runtime.ready_timeout_s": "How long may a node take to load, to warm up and to find the others?",
            "runtime.watchdog_ms": "After how long without a sign of life has a node stalled? none: 2 s, at rate "
            '"max" a minute',
            "runtime.restart": 'Is a node that died or stalled restarted? none: "always", but "never" at rate "max", '
            "which may lose no image",
            "runtime.restarts_max": "How often may that be, before the run ends?",
            "runtime.restart_window_s": "Within which time do these restarts count?",
            "runtime.spares": "Does a process of each node stand by for that, loaded and warm?",
            "realtime.fifo": 'Do nodes go before all else (SCHED_FIFO)? "auto": all of them with a live camera, else '
            "capture and optimize, and perceive's frames before its networks",
            "realtime.lock_memory": 'Does their memory stay in RAM? "auto": with a live camera',
            "realtime.NODE.priority": "Which priority has a node, under SCHED_FIFO?",
            "realtime.NODE.cpus": "On which cores may it run? none: all",
        },
    ),
    Group(
        "ROS 2, live",
        "See [ros.md](ros.md). Of `birdslam ros`, and of a source `ros:/TOPIC`.",
        {
            "ros.router": "Where is the router of rmw_zenoh?",
            "ros.domain": "Which domain? none: as the variable ROS_DOMAIN_ID says, else 0",
            "ros.namespace": 'What stands before the names of our topics and frames, where there are several cars? "": '
            "nothing",
            "ros.release": "Which release of ROS 2 do the others run? Humble has no hashes of types; jazzy: any later",
        },
    ),
    Group(
        "A fleet",
        "See [deployment.md](deployment.md). `[fleet]` is a vehicle's or a listener's, `[router]` that of "
        "`birdslam router`.",
        {
            "fleet.router": 'Where is the router? tls/HOST:PORT; "": there is none',
            "fleet.ca": "Which file is the fleet's authority? FILE.pem",
            "fleet.certificate": "Which is this computer's certificate? FILE.pem",
            "fleet.key": "Which file is the private key?",
            "fleet.estimates_hz": "How many estimates a second are sent at the most? none: all",
            "fleet.vehicles": "Which vehicles does a listener expect, and lists before their first message?",
            "router.listen": "Where do vehicles and listeners connect to?",
            "router.ca": "Which file is the fleet's authority? FILE.pem",
            "router.certificate": "Which is the router's certificate? FILE.pem",
            "router.key": "Which file is the private key?",
            "router.vehicles": 'Which vehicles are there? Each has a certificate named "vehicle NAME", and writes its '
            "own "
            "keys alone",
            "router.listeners": "Who may read all vehicles, and write nothing? Common names of certificates",
            "router.messages_hz": "How many of a vehicle's messages on one key pass a second? The rest is dropped",
        },
    ),
)

KEYS = {key: question for group in GROUPS for key, question in group.questions.items()}
