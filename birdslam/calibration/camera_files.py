"""Camera files of other projects, recognized by their content: intrinsics, lens distortion and image size.

ROS camera_info and OpenCV (YAML, XML, JSON), Kalibr, ORB-SLAM3, COLMAP, nuScenes, and KITTI's text files. Everything
here raises DatasetError with the file and the reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from birdslam.calibration.intrinsics import Intrinsics
from birdslam.sources.kitti import read_projection
from birdslam.sources.recording import DatasetError

KITTI_KEYS = ("P0", "P2", "P_rect_00", "P_rect_02")
DISTORTIONS = ("plumb_bob", "rational_polynomial", "radtan", "thin_prism", "equidistant", "")  # of ROS; OpenCV: none
FISHEYES = ("equidistant", "kannala_brandt", "KannalaBrandt8")
MAX_SIDE_PX = 1 << 16  # of an image
COEFFICIENTS = (4, 5, 8, 12, 14)  # OpenCV's models of distortion
# Parameters of COLMAP's models after the focal lengths and the principal point, in the order of OpenCV's coefficients
COLMAP: dict[str, tuple[int, tuple[int | None, ...], bool]] = {  # name: focal lengths, coefficients, fisheye
    "SIMPLE_PINHOLE": (1, (), False),
    "PINHOLE": (2, (), False),
    "SIMPLE_RADIAL": (1, (0, None, None, None), False),
    "RADIAL": (1, (0, 1, None, None), False),
    "OPENCV": (2, (0, 1, 2, 3), False),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7), False),
    "SIMPLE_RADIAL_FISHEYE": (1, (0, None, None, None), True),
    "RADIAL_FISHEYE": (1, (0, 1, None, None), True),
    "OPENCV_FISHEYE": (2, (0, 1, 2, 3), True),
}
_COLMAP_LINE = re.compile(r"^\s*\d+\s+([A-Z][A-Z_]+)\s+\d+\s+\d+(\s+\S+)+\s*$", re.MULTILINE)
_KITTI_LINE = re.compile(r"^(P\d|P_rect_\d\d|calib_time):", re.MULTILINE)
_ORB_LINE = re.compile(r"^Camera1?\.fx:", re.MULTILINE)
_KALIBR_LINE = re.compile(r"^cam\d+:\s*$", re.MULTILINE)
FORMATS = "KITTI, ROS camera_info, OpenCV, Kalibr, ORB-SLAM3, COLMAP, nuScenes"


def format_of(path: Path) -> str | None:
    """The format of a camera file of another project; None if unknown or unreadable."""
    try:
        return _recognized(_text(path))
    except DatasetError:
        return None


def read_intrinsics(path: Path, key: str | None = None) -> Intrinsics:
    """Reads a calibration file of any known format; `key` names the projection matrix of a KITTI file."""
    text = _text(path)
    name = _recognized(text)
    if name == "KITTI" or key:
        return _kitti(path, text, key)
    if name == "COLMAP":
        return _colmap(path, text)
    if name == "OpenCV":
        return _of_matrices(path, _opencv_storage(path, text))
    tree = _tree(path, text)
    if name == "nuScenes":
        return _nuscenes(path, tree)
    if not isinstance(tree, dict):
        raise DatasetError(f"{path}: has no camera; expected a file of {FORMATS}")
    if name == "Kalibr":
        return _kalibr(path, tree)
    if name == "ORB-SLAM3":
        return _orb_slam(path, tree)
    return _of_matrices(path, tree)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None


def _recognized(text: str) -> str | None:
    if text.lstrip().startswith("<?xml") and "<opencv_storage" in text:
        return "OpenCV"
    if _KITTI_LINE.search(text):
        return "KITTI"
    if _ORB_LINE.search(text):
        return "ORB-SLAM3"
    if _KALIBR_LINE.search(text) and "intrinsics:" in text:
        return "Kalibr"
    if '"camera_intrinsic"' in text:
        return "nuScenes"
    found = _COLMAP_LINE.search(text)
    if found is not None and not text.lstrip().startswith(("%YAML", "{", "[")):
        return "COLMAP"
    words = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "distortion_model")
    return "ROS or OpenCV" if any(word in text for word in words) else None


class _Loader(yaml.SafeLoader):
    """Plain YAML with OpenCV's matrices as mappings."""


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, True))


def _tree(path: Path, text: str) -> Any:
    if text.startswith("%YAML"):  # OpenCV writes "%YAML:1.0", which is not YAML
        text = text.partition("\n")[2]
    try:
        # The first document: `rostopic echo` separates messages by "---"
        return next((document for document in yaml.load_all(text, _Loader) if document is not None), None)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise DatasetError(f"{path}: not YAML: {' '.join(str(error).split())[:200]}") from None


def _opencv_storage(path: Path, text: str) -> dict[str, Any]:
    """Reads an XML file of cv2.FileStorage like `_tree` reads YAML; OpenCV's own parser overflows on long numbers."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DatasetError(f"{path}: XML with a DOCTYPE is not supported")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not an OpenCV storage: {error}") from None
    matrices = ((node, node.findtext("data")) for node in root)
    return {node.tag: _number(node.text or "") if data is None else data.split() for node, data in matrices}


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text.strip()


def _kitti(path: Path, text: str, key: str | None) -> Intrinsics:
    """From a projection matrix of a rectified camera; KITTI raw states the image size beside it."""
    reason = ""
    for name in (key,) if key else KITTI_KEYS:
        try:
            P = read_projection(path, name)
        except DatasetError as error:
            if "has no" not in str(error):
                raise
            reason = str(error)
            continue
        sizes = {line.partition(":")[0]: line.split()[1:] for line in text.splitlines() if line.startswith("S_rect")}
        size = _numbers(path, sizes, (name.replace("P_", "S_"),)) or ()
        width, height = (_side(path, side) for side in (size if len(size) == 2 else (None, None)))
        return Intrinsics(
            fx_px=P[0, 0],
            fy_px=P[1, 1],
            cx_px=P[0, 2],
            cy_px=P[1, 2],
            width_px=width,
            height_px=height,
            source=f"{path} ({name}, rectified)",
        )
    raise DatasetError(reason if key else f"{path}: has none of {', '.join(KITTI_KEYS)}")


def _of_matrices(path: Path, tree: Mapping[str, Any]) -> Intrinsics:
    """From ROS camera_info or OpenCV's calibration: matrix, coefficients and size under several names."""
    K = _numbers(path, tree, ("camera_matrix", "K", "k", "Camera_Matrix", "cameraMatrix", "intrinsic_matrix"))
    if K is None:
        raise DatasetError(f"{path}: has neither camera_matrix nor K; expected a file of {FORMATS}")
    if len(K) != 9:
        raise DatasetError(f"{path}: its camera matrix has {len(K)} numbers, not 9")
    if not any(K):
        raise DatasetError(f"{path}: its camera matrix is zero: the camera is not calibrated")
    if max(abs(K[i]) for i in (1, 3, 6, 7)) > 1e-6 * max(abs(K[0]), 1.0) or K[8] != 1.0:
        raise DatasetError(f"{path}: its camera matrix is invalid or has a skew: {K}")
    keys = ("distortion_coefficients", "D", "d", "Distortion_Coefficients", "distortion", "distCoeffs", "dist_coeffs")
    distortion = _numbers(path, tree, keys) or []
    model = str(tree.get("distortion_model") or "")
    if model not in DISTORTIONS and any(distortion):
        raise DatasetError(f"{path}: distortion_model {model} is not supported (only {', '.join(DISTORTIONS[:-1])})")
    # OpenCV's calibration sample writes `fisheye_model: 1`
    fisheye = model in FISHEYES or bool(tree.get("fisheye_model"))
    size = tree.get("image_size") or tree.get("resolution") or (None, None)
    width, height = size if isinstance(size, (list, tuple)) and len(size) == 2 else (None, None)
    return _intrinsics(
        path,
        (K[0], K[4], K[2], K[5]),
        distortion,
        fisheye,
        _first(tree, ("image_width", "width", "image_Width"), width),
        _first(tree, ("image_height", "height", "image_Height"), height),
    )


def _kalibr(path: Path, tree: Mapping[str, Any]) -> Intrinsics:
    """From a camchain of Kalibr with one camera or several equal ones."""
    cameras = {name: camera for name, camera in tree.items() if re.fullmatch(r"cam\d+", str(name))}
    if len(cameras) > 1:
        raise DatasetError(f"{path}: has {len(cameras)} cameras; keep one of them ({', '.join(cameras)})")
    name, camera = next(iter(cameras.items()), ("", None))
    if not isinstance(camera, dict):
        raise DatasetError(f"{path}: {name or 'it'} has no camera")
    if (projection := str(camera.get("camera_model"))) != "pinhole":
        raise DatasetError(f"{path}: camera_model {projection} is not supported (only pinhole)")
    focal = _numbers(path, camera, ("intrinsics",)) or []
    if len(focal) != 4:
        raise DatasetError(f"{path}: intrinsics of {name} has {len(focal)} numbers, not 4 (fu, fv, pu, pv)")
    model = str(camera.get("distortion_model") or "none")
    if model not in ("radtan", "equidistant", "none"):
        raise DatasetError(f"{path}: distortion_model {model} is not supported (only radtan, equidistant)")
    distortion = _numbers(path, camera, ("distortion_coeffs",)) or []
    size = _numbers(path, camera, ("resolution",))
    width, height = size if size and len(size) == 2 else (None, None)
    return _intrinsics(path, focal, distortion, model == "equidistant", width, height)


def _orb_slam(path: Path, tree: Mapping[str, Any]) -> Intrinsics:
    """From a settings file of ORB-SLAM2 or ORB-SLAM3; `Camera1.` is the first camera of version 1.0."""
    kind = str(tree.get("Camera.type") or "PinHole")
    if kind.lower() not in ("pinhole", "rectified", "kannalabrandt8"):
        raise DatasetError(f"{path}: Camera.type {kind} is not supported (only PinHole, Rectified, KannalaBrandt8)")
    prefix = "Camera1." if "Camera1.fx" in tree else "Camera."

    def number(name: str) -> float | None:
        found = _numbers(path, tree, (prefix + name,))
        return None if found is None else found[0]

    focal = [number(name) for name in ("fx", "fy", "cx", "cy")]
    if None in focal:
        raise DatasetError(f"{path}: lacks one of {prefix}fx, fy, cx, cy")
    fisheye = kind.lower() == "kannalabrandt8"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    coefficients = [number(name) for name in names]
    distortion = [value or 0.0 for value in coefficients]
    if not fisheye and coefficients[4] is None:
        distortion = distortion[:4]
    width, height = (tree.get(f"Camera.{side}") for side in ("width", "height"))
    known = [value for value in focal if value is not None]
    return _intrinsics(path, known, distortion, fisheye, width, height)


def _colmap(path: Path, text: str) -> Intrinsics:
    """From COLMAP's cameras.txt, whose pixel centres have half coordinates."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len({tuple(row[1:]) for row in rows}) > 1:
        raise DatasetError(f"{path}: has {len(rows)} different cameras; keep one of them")
    _, model, *words = rows[0]
    if model not in COLMAP:
        raise DatasetError(f"{path}: camera model {model} is not supported (only {', '.join(COLMAP)})")
    focals, order, fisheye = COLMAP[model]
    try:
        width, height, *parameters = (float(word) for word in words)
    except ValueError:
        raise DatasetError(f"{path}: a camera's line contains a value that is not a number") from None
    expected = focals + 2 + sum(k is not None for k in order)
    if len(parameters) != expected or not np.isfinite(parameters).all():
        raise DatasetError(f"{path}: {model} has {len(parameters)} parameters, not {expected}")
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *rest = parameters[focals:]
    distortion = [0.0 if k is None else rest[k] for k in order]
    return _intrinsics(path, (fx, fy, cx - 0.5, cy - 0.5), distortion, fisheye, width, height)


def _nuscenes(path: Path, tree: Any) -> Intrinsics:
    """From nuScenes' calibrated_sensor.json, or one entry of it; its images are undistorted."""
    entries = tree if isinstance(tree, list) else [tree]
    matrices = {json.dumps(entry["camera_intrinsic"]) for entry in entries if _has_matrix(entry)}
    if len(matrices) != 1:
        raise DatasetError(f"{path}: has {len(matrices)} different cameras; keep the entry of one")
    K = np.array(json.loads(matrices.pop()), np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise DatasetError(f"{path}: camera_intrinsic is not a matrix of 3x3 numbers")
    return _intrinsics(path, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (), False, None, None)


def _has_matrix(entry: object) -> bool:
    return isinstance(entry, dict) and bool(entry.get("camera_intrinsic"))


def _intrinsics(
    path: Path,
    focal_px: Sequence[float],
    distortion: Sequence[float],
    fisheye: bool,
    width_px: object,
    height_px: object,
) -> Intrinsics:
    """`focal_px` is fx, fy, cx, cy. An equidistant lens distorts also with zero coefficients."""
    if fisheye and len(distortion) > 4:
        raise DatasetError(f"{path}: a fisheye model has 4 coefficients, not {len(distortion)}")
    if min(focal_px[:2]) <= 0.0:
        raise DatasetError(f"{path}: invalid focal length of {min(focal_px[:2]):g} px")
    if any(distortion) and not fisheye and len(distortion) not in COEFFICIENTS:
        counts = ", ".join(map(str, COEFFICIENTS))
        raise DatasetError(f"{path}: has {len(distortion)} distortion coefficients; OpenCV's models have {counts}")
    fx, fy, cx, cy = (float(value) for value in focal_px)
    return Intrinsics(
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        distortion=tuple(map(float, distortion)) if any(distortion) or fisheye else (),
        fisheye=fisheye,
        width_px=_side(path, width_px),
        height_px=_side(path, height_px),
        source=str(path),
    )


def _numbers(path: Path, tree: Mapping[str, Any], keys: Iterable[str]) -> list[float] | None:
    for key in keys:
        value = tree.get(key)
        if value is None:
            continue
        data = value.get("data") if isinstance(value, dict) else value
        try:
            numbers = np.array(data, dtype=np.float64).ravel()
        except (TypeError, ValueError, OverflowError):
            raise DatasetError(f"{path}: {key} contains a value that is not a number") from None
        if not np.isfinite(numbers).all() or not len(numbers):
            raise DatasetError(f"{path}: {key} has numbers that are not finite")
        out: list[float] = numbers.tolist()
        return out
    return None


def _first(tree: Mapping[str, Any], keys: Iterable[str], default: object) -> object:
    return next((tree[key] for key in keys if tree.get(key) is not None), default)


def _side(path: Path, value: object) -> int | None:
    """A side of the image in px, which may be missing. Raises DatasetError."""
    if value is None:
        return None
    if not isinstance(value, int | float) or not 1.0 <= value <= MAX_SIDE_PX or value != int(value):
        raise DatasetError(f"{path}: invalid image size {str(value)[:40]!r}")
    return int(value)
