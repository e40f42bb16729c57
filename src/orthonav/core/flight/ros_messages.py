"""Images, cameras, attitudes and heights of ROS messages; axes: REP 103 and REP 105."""

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight import decode_image
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import camera_from_numbers
from orthonav.core.records import grey_levels
from orthonav.core.tilt import stated_deg

_NOT_BODY = ("camera", "optical", "gimbal", "lidar", "laser", "ned", "frd")
_NOT_DOWN = ("front", "forward", "rear", "back", "backward", "left", "right", "up", "upward")


def stamp_ns(message: Any, recorded_ns: int) -> int:
    """Time stamp of a message, or the time of its recording where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    stamped = 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return stamped or recorded_ns


def attitude_of_message(message: Any) -> tuple[float, float, float, float] | None:
    """The orientation w, x, y, z in a `sensor_msgs/Imu`, `nav_msgs/Odometry` or
    `geometry_msgs/PoseStamped`: from forward-left-up to east-north-up (REP 103).

    None without one: an `Imu` says so, and others send zeros or 0 0 0 1.
    """
    if hasattr(message, "orientation_covariance"):
        if message.orientation_covariance[0] == -1:
            return None
        turn = message.orientation
    elif hasattr(message.pose, "pose"):
        turn = message.pose.pose.orientation
    else:
        turn = message.pose.orientation
    if not (turn.x or turn.y or turn.z):
        return None
    return float(turn.w), float(turn.x), float(turn.y), float(turn.z)


def odd_word(message: Any, topic: str = "") -> str:
    """The word in the name of a frame, or of the topic of a `Range`, by which it does not look down
    or another message is not of the body; "" without one."""
    ranges, header = hasattr(message, "max_range"), getattr(message, "header", None)
    named = getattr(header, "frame_id", ""), getattr(message, "child_frame_id", "")
    frames = (re.split("/|::", frame)[-1] for frame in named)  # without that of its vehicle
    words = re.findall("[a-z]+", " ".join((topic * ranges, *frames)).lower())
    return next((word for word in words if word in (_NOT_DOWN if ranges else _NOT_BODY)), "")


def horizon_std_of_message(message: Any) -> float | None:
    """Standard deviation of pitch and roll (deg) by the covariance of a `sensor_msgs/Imu`; None
    where it is not stated, or is a placeholder."""
    covariance = getattr(message, "orientation_covariance", (0.0,) * 9)
    return stated_deg((float(covariance[0]), float(covariance[4])))


def height_of_message(message: Any) -> float | None:
    """Metres above ground of a `sensor_msgs/Range` or a plain number.

    None for a range that is not within the limits of its sensor: infinite ones show no distance.
    """
    if hasattr(message, "range"):
        sound = message.min_range < message.range < message.max_range
        return float(message.range) if sound else None
    return float(message.data)


Grey = NDArray[np.uint8]
# encoding: bytes per channel, channels, conversion to grey.
_TO_GREY: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8uc1": (1, 1, None),
    "mono16": (2, 1, None),
    "16uc1": (2, 1, None),
    "bgr8": (1, 3, cv2.COLOR_BGR2GRAY),
    "8uc3": (1, 3, cv2.COLOR_BGR2GRAY),
    "rgb8": (1, 3, cv2.COLOR_RGB2GRAY),
    "bgra8": (1, 4, cv2.COLOR_BGRA2GRAY),
    "8uc4": (1, 4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (1, 4, cv2.COLOR_RGBA2GRAY),
    **{
        f"bayer_{order}{8 * width}": (width, 1, getattr(cv2, f"COLOR_Bayer{order.upper()}2GRAY"))
        for order in ("rggb", "bggr", "gbrg", "grbg")
        for width in (1, 2)
    },
}


def grey_of_message(message: Any, where: str) -> Grey:
    """Grey levels (H, W) uint8 of a `sensor_msgs/Image` or `CompressedImage`.

    Raises `FlightError` where it cannot be decoded.
    """
    if hasattr(message, "encoding"):
        return grey_of_image(message, where)
    return decode_image(np.asarray(message.data, dtype=np.uint8).tobytes(), where)


def grey_of_image(message: Any, where: str) -> Grey:
    """Grey levels (H, W) uint8 of a `sensor_msgs/Image`; of 16 bits as `grey_levels`.

    Raises `FlightError` for unknown encodings and data of a wrong size.
    """
    encoding = str(message.encoding).lower()
    if encoding not in _TO_GREY:
        raise FlightError(f"image encoding '{message.encoding}' is not supported: {where}")
    width, channels, conversion = _TO_GREY[encoding]
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    data, row_bytes = np.asarray(message.data, dtype=np.uint8), columns * width * channels
    if rows < 1 or columns < 1 or step < row_bytes or data.size < rows * step:
        raise FlightError(f"image is cut short or has no size: {where}")
    packed = np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :row_bytes])
    kind = np.uint8 if width == 1 else np.dtype(">u2" if message.is_bigendian else "<u2")
    pixels: NDArray[Any] = packed.view(kind).reshape(rows, columns, channels)
    if channels == 1:
        pixels = pixels[..., 0]
    if conversion is not None:
        pixels = cv2.cvtColor(pixels.astype(pixels.dtype.newbyteorder("=")), conversion)
    return grey_levels(pixels.astype(pixels.dtype.newbyteorder("="), copy=False))


def camera_of_info(message: Any, topic: str = "") -> Camera:
    """The camera of a `sensor_msgs/CameraInfo` for images of a topic: matrix P without distortion
    where it is named as rectified, such as `image_rect`, else K.

    Raises `CameraError` where it is not calibrated, or has an unsupported model.
    """
    rectified = re.search("(^|[/_])rect(ified)?(?=[/_]|$)", topic) is not None
    name = "P" if rectified else "K"
    matrix = np.ravel(getattr(message, name, getattr(message, name.lower(), [])))
    lens = np.ravel(getattr(message, "D", getattr(message, "d", [])))
    columns = 4 if rectified else 3
    if matrix.size != 3 * columns or matrix[0] <= 0:
        raise CameraError(f"camera_info is not calibrated: no matrix {name}; give --camera FILE")
    roi = message.roi
    if message.binning_x > 1 or message.binning_y > 1 or roi.width or roi.height:
        raise CameraError("camera_info with binning or a region of interest; give --camera FILE")
    numbers = matrix.reshape(3, columns)[:, :3].ravel().tolist()
    size = message.width, message.height
    if rectified:
        return camera_from_numbers(size, numbers, [], "plumb_bob")
    return camera_from_numbers(size, numbers, lens.tolist(), str(message.distortion_model))
