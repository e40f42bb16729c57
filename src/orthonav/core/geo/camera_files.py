"""Camera files of other programs: OpenCV, ROS and Kalibr count from the first pixel's centre."""

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from orthonav.core.errors import CameraError, MissingExtraError
from orthonav.core.files import require_file
from orthonav.core.flight.folder import BROKEN, camera_from_plain
from orthonav.core.geo.camera import Camera
from orthonav.core.guard import needed

OPENCV_HEADER = "%YAML:1.0"
_READ = (
    "expected flight.json, or a camera of OpenCV (camera_matrix, image_width, .. as YAML, XML or "
    "JSON), ROS (camera_matrix, distortion_coefficients, ..) or Kalibr (intrinsics, resolution, ..)"
)


def read_camera_file(path: Path) -> Camera:
    """The camera of a `flight.json`, or of a file of OpenCV, ROS or Kalibr.

    `FILE#cam1` selects one camera of a Kalibr chain. Raises `MissingFileError`, `CameraError` or
    `MissingExtraError`."""
    path, name = _name_apart(Path(path))
    path = require_file(path, "camera file")
    if path.stat().st_size > 1_000_000:
        raise CameraError(f"camera file is larger than 1 MB: {path}")
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CameraError(f"camera file is not UTF-8 text: {path}") from error
    try:
        # Kalibr chains may begin with OpenCV's header, which is not YAML.
        chain = re.search(r"^cam\d+\s*:", text, re.MULTILINE) is not None
        if name is not None and not chain:
            raise CameraError(f"file is not a Kalibr chain; give it without #{name:.60}")
        if not chain and (text.startswith(OPENCV_HEADER) or "opencv-matrix" in text):
            return _plain(_opencv(text))
        if text.lstrip().startswith("{"):
            plain = json.loads(text)
            return camera_from_plain(plain["camera"]) if "camera" in plain else _plain(plain)
        return _plain(_yaml(text.removeprefix(OPENCV_HEADER)), name)
    except CameraError as error:
        raise CameraError(f"{error}: {path}") from error
    except (*BROKEN, IndexError) as error:
        found = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise CameraError(f"{_READ}; {found}: {path}") from error


def masked(camera: Camera, path: Path) -> Camera:
    """A camera with the mask of an image file, see `Camera.masked`.

    Raises `MissingFileError` or `CameraError`."""
    path = require_file(path, "mask of the camera")
    try:
        mask = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # an empty file
        mask = None
    if mask is None:
        raise CameraError(f"mask cannot be decoded: {path}")
    try:
        return camera.masked(mask)
    except CameraError as error:
        raise CameraError(f"{error}: {path}") from error


def camera_from_numbers(
    size_px: Sequence[int], matrix: Any, distortion: Any, model: str, unusual: bool = False
) -> Camera:
    """`matrix`: 9 numbers, row by row."""
    numbers = tuple(float(number) for number in distortion)
    if model in ("equidistant", "fisheye"):
        ours = "fisheye"
    elif model in ("", "brown", "plumb_bob", "rational_polynomial", "radtan", "none"):
        ours = "brown"
        if any(numbers[5:]):
            raise CameraError(
                f"distortion with more than k1,k2,p1,p2,k3 is not supported, got {numbers}"
            )
        numbers = (*numbers, *(0.0,) * (4 - len(numbers))) if 0 < len(numbers) < 4 else numbers[:5]
    else:
        raise CameraError(f"distortion model '{model}' is not supported; brown and equidistant are")
    k, (width, height) = np.array(matrix, dtype=np.float64), map(int, size_px)
    if k.shape != (9,):
        raise ValueError(f"9 numbers were expected, got {len(k)}")
    return Camera.from_matrix(k.reshape(3, 3), numbers, (width, height), ours, unusual=unusual)


def _yaml(text: str) -> Any:
    try:
        yaml = needed("yaml", "camera files in YAML")
    except MissingExtraError:
        with contextlib.suppress(CameraError):  # OpenCV reads most of what ROS and Kalibr write
            return _opencv(f"{OPENCV_HEADER}\n---\n{text}")
        raise
    try:
        _check_events(yaml, text)
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CameraError(f"camera file is not YAML ({error.__class__.__name__})") from error


def _check_events(yaml: Any, text: str) -> None:
    """Refuses YAML whose aliases, nesting or numbers with colons could exhaust memory or time."""
    depth, most_parts, most_levels, most_chars = 0, 20_000, 20, 10_000
    for count, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
        if getattr(event, "anchor", None) is not None:
            raise CameraError("camera file has anchors or aliases: write the values out")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        long = isinstance(event, yaml.ScalarEvent) and len(event.value) > most_chars
        if depth > most_levels or count > most_parts or long:
            raise CameraError(
                f"camera file has more than {most_parts} parts, {most_levels} levels or "
                f"{most_chars} characters in one value"
            )


def _name_apart(path: Path) -> tuple[Path, str | None]:
    """The file and the camera after `#`; an existing file may have `#` in its name."""
    file, mark, name = str(path).rpartition("#")
    return (path, None) if not mark or path.exists() else (Path(file), name)


def _plain(plain: Any, name: str | None = None) -> Camera:
    if not isinstance(plain, Mapping):
        raise TypeError(f"a mapping was expected, got {type(plain).__name__}")
    cameras = [name for name in plain if str(name).startswith("cam") and str(name)[3:].isdecimal()]
    if name is not None and name not in cameras:
        raise CameraError(f"file holds no camera {name!r:.60}, it holds {', '.join(cameras)}")
    if name is None and len(cameras) > 1:
        raise CameraError(f"file holds {', '.join(cameras)}; select one as FILE#{cameras[0]}")
    if cameras:
        return _kalibr(plain[name or cameras[0]])
    if "intrinsics" in plain:
        return _kalibr(plain)
    lens = "distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D", "D1"
    fisheye = plain.get("fisheye_model") or plain.get("fisheye")
    return camera_from_numbers(
        [_first(plain, f"image_{side}", f"image_{side.title()}") for side in ("width", "height")],
        _data(_first(plain, "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M1")),
        _data(next((plain[name] for name in lens if name in plain), [])),
        "fisheye" if fisheye else str(plain.get("distortion_model", "plumb_bob")),
        bool(plain.get("unusual")),
    )


def _kalibr(plain: Mapping[str, Any]) -> Camera:
    if plain["camera_model"] != "pinhole":
        raise CameraError(f"camera model '{plain['camera_model']}' is not supported; pinhole is")
    fx, fy, cx, cy = plain["intrinsics"]
    return camera_from_numbers(
        plain["resolution"],
        (fx, 0, cx, 0, fy, cy, 0, 0, 1),
        plain.get("distortion_coeffs", []),
        str(plain.get("distortion_model", "none")),
        bool(plain.get("unusual")),
    )


def _opencv(text: str) -> Any:
    # OpenCV crashes where nesting is deeper than the stack. Whatever opens a level for it counts,
    # -- and a:b: included; a minus before a number does not.
    if len(re.findall(r"[\[{<:]|-(?![\d.])", text)) > 5000:
        raise CameraError("camera file has more than 5000 parts")
    try:
        storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
        try:
            return _value(storage.root())
        finally:
            storage.release()
    except (cv2.error, SystemError) as error:
        raise CameraError("camera file cannot be read by OpenCV") from error


def _value(node: cv2.FileNode) -> Any:
    # Not `mat`: it writes beyond its memory where rows, columns and data disagree.
    if node.isMap():
        names = node.keys()
        return {name: _value(node.getNode(name)) for name in names}
    if node.isSeq():  # long ones, points of a calibration, are not needed and take minutes
        return [_value(node.at(n)) for n in range(node.size())] if node.size() < 100 else []
    return node.string() if node.isString() else node.real()


def _first(plain: Mapping[str, Any], *names: str) -> Any:
    return plain[next((name for name in names if name in plain), names[0])]


def _data(matrix: Any) -> Any:
    """Of a matrix with rows, cols and data, or of plain lists."""
    if not isinstance(matrix, Mapping):
        return np.ravel(matrix)
    data = np.ravel(matrix["data"])
    if int(matrix.get("rows", 1)) * int(matrix.get("cols", len(data))) != len(data):
        raise CameraError("rows, columns and data of a matrix disagree")
    return data
