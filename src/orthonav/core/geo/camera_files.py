"""Camera files of other programs: OpenCV, ROS and Kalibr count from the first pixel's centre."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from orthonav.core.errors import CameraError
from orthonav.core.files import require_file
from orthonav.core.flight import read_camera
from orthonav.core.geo.camera import Camera
from orthonav.core.guard import needed

MAX_BYTES = 1_000_000
MAX_EVENTS = 20_000
MAX_DEPTH = 20
MAX_VALUE_CHARS = 10_000
MAX_OPENINGS = 5000
_OPENCV_HEADER = "%YAML:1.0"
_CHAIN = re.compile(r"^cam\d+\s*:", re.MULTILINE)
_BROWN = ("", "brown", "plumb_bob", "rational_polynomial", "radtan", "none")
_FISHEYE = ("equidistant", "fisheye")
_BROKEN = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    IndexError,
    RecursionError,
)
# Whatever opens a level for OpenCV, -- and a:b: included; a minus before a number does not.
_OPENING = re.compile(r"[\[{<:]|-(?![\d.])")


def read_camera_file(path: Path) -> Camera:
    """The camera of a `flight.json`, or of a file of OpenCV (YAML, JSON), ROS or Kalibr (YAML).

    `FILE#cam1` selects one camera of a Kalibr chain. Raises `MissingFileError`, `CameraError` or
    `MissingExtraError`."""
    path, name = _name_apart(Path(path))
    path = require_file(path, "camera file")
    if path.stat().st_size > MAX_BYTES:
        raise CameraError(f"camera file is larger than {MAX_BYTES // 10**6} MB: {path}")
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CameraError(f"camera file is not UTF-8 text: {path}") from error
    try:
        # Kalibr chains may begin with OpenCV's header, which is not YAML.
        chain = _CHAIN.search(text) is not None
        if name is not None and not chain:
            raise CameraError(f"file is not a Kalibr chain; give it without #{name:.60}")
        if not chain and (text.startswith(_OPENCV_HEADER) or "opencv-matrix" in text):
            return _opencv(text)
        if text.lstrip().startswith("{"):
            plain = json.loads(text)
            return read_camera(path)[0] if "camera" in plain else _plain(plain)
        return _plain(_yaml(text.removeprefix(_OPENCV_HEADER)), name)
    except CameraError as error:
        raise CameraError(f"{error}: {path}") from error
    except _BROKEN as error:
        found = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise CameraError(
            "expected flight.json, or a camera of OpenCV (camera_matrix, image_width, ..), ROS "
            "(camera_matrix, distortion_coefficients, ..) or Kalibr (intrinsics, resolution, ..); "
            f"{found}: {path}"
        ) from error


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
    size_px: Sequence[int], matrix: Sequence[float], distortion: Sequence[float], model: str
) -> Camera:
    fx, fy, cx, cy = (float(number) for number in matrix)
    numbers = tuple(float(number) for number in distortion)
    if model in _FISHEYE:
        ours = "fisheye"
    elif model in _BROWN:
        ours = "brown"
        if any(numbers[5:]):
            raise CameraError(
                f"distortion with more than k1,k2,p1,p2,k3 is not supported, got {numbers}"
            )
        numbers = (*numbers, *(0.0,) * (4 - len(numbers))) if 0 < len(numbers) < 4 else numbers[:5]
    else:
        raise CameraError(f"distortion model '{model}' is not supported; brown and equidistant are")
    return Camera(int(size_px[0]), int(size_px[1]), fx, fy, cx + 0.5, cy + 0.5, numbers, model=ours)


def _yaml(text: str) -> Any:
    yaml = needed("yaml", "camera files in YAML")
    try:
        _check_events(yaml, text)
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CameraError(f"camera file is not YAML ({error.__class__.__name__})") from error


def _check_events(yaml: Any, text: str) -> None:
    """Refuses YAML whose aliases, nesting or numbers with colons could exhaust memory or time."""
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
        if getattr(event, "anchor", None) is not None:
            raise CameraError("camera file has anchors or aliases: write the values out")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        long = isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_VALUE_CHARS
        if depth > MAX_DEPTH or count > MAX_EVENTS or long:
            raise CameraError(
                f"camera file has more than {MAX_EVENTS} parts, {MAX_DEPTH} levels or "
                f"{MAX_VALUE_CHARS} characters in one value"
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
    matrix = _numbers(plain["camera_matrix"]["data"], 9)
    return camera_from_numbers(
        (plain["image_width"], plain["image_height"]),
        matrix[[0, 4, 2, 5]].tolist(),
        plain["distortion_coefficients"]["data"],
        str(plain.get("distortion_model", "plumb_bob")),
    )


def _kalibr(plain: Mapping[str, Any]) -> Camera:
    if plain["camera_model"] != "pinhole":
        raise CameraError(f"camera model '{plain['camera_model']}' is not supported; pinhole is")
    return camera_from_numbers(
        plain["resolution"],
        plain["intrinsics"],
        plain.get("distortion_coeffs", []),
        str(plain.get("distortion_model", "none")),
    )


def _opencv(text: str) -> Camera:
    # OpenCV crashes where nesting is deeper than the stack.
    if sum(1 for _ in _OPENING.finditer(text)) > MAX_OPENINGS:
        raise CameraError(f"camera file has more than {MAX_OPENINGS} parts")
    try:
        storage = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
        try:
            return _stored(storage)
        finally:
            storage.release()
    except (cv2.error, SystemError) as error:
        raise CameraError("camera file cannot be read by OpenCV") from error


def _stored(storage: cv2.FileStorage) -> Camera:
    matrix = _matrix(storage, "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M1")
    lens = _matrix(
        storage, "distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D", "D1"
    )
    sides = [_whole(storage, f"image_{side}") for side in ("width", "height")]
    if 0 in sides:
        sides = [_whole(storage, f"image_{side}") for side in ("Width", "Height")]
    if matrix is None or matrix.size != 9 or 0 in sides:
        raise CameraError("file lacks camera_matrix, image_width or image_height")
    fisheye = _whole(storage, "fisheye_model") or _whole(storage, "fisheye")
    return camera_from_numbers(
        sides,
        matrix[[0, 4, 2, 5]].tolist(),
        [] if lens is None else lens.tolist(),
        "fisheye" if fisheye else "brown",
    )


def _matrix(storage: cv2.FileStorage, *names: str) -> Any:
    for name in names:
        # Not `mat`: it writes beyond its memory where rows, columns and data disagree.
        node, data = storage.getNode(name), storage.getNode(name).getNode("data")
        if not data.empty():
            numbers = [data.at(i).real() for i in range(data.size())]
            if math.prod(node.getNode(each).real() for each in ("rows", "cols")) != len(numbers):
                raise CameraError(f"rows, columns and data of {name} disagree")
            return np.array(numbers)
    return None


def _whole(storage: cv2.FileStorage, name: str) -> int:
    node = storage.getNode(name)
    return int(node.real()) if not node.empty() and (node.isInt() or node.isReal()) else 0


def _numbers(values: Any, count: int) -> Any:
    numbers = np.array(values, dtype=np.float64)
    if numbers.shape != (count,):
        raise ValueError(f"{count} numbers were expected, got {len(numbers)}")
    return numbers
