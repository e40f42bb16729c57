"""Messages of ROS 2 by the definitions of `rosbags`; images, cameras, attitudes and heights of ROS
messages. Axes: REP 103 and REP 105."""

import math
import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.extras import needed
from orthonav.core.flight import decode_image
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import camera_from_numbers
from orthonav.core.records import grey_levels
from orthonav.core.tilt import stated_deg

TIME_NS = 10**9
NO_ALTITUDE_M2 = 1e8
"""Vertical variance of a position: a fix has no altitude of its own."""
_GEOGRAPHIC = {
    "geographic_msgs/msg/GeoPoint": "float64 latitude\nfloat64 longitude\nfloat64 altitude\n",
    "geographic_msgs/msg/GeoPointStamped": (
        "std_msgs/Header header\ngeographic_msgs/GeoPoint position\n"
    ),
}
Grey = NDArray[np.uint8]
_NOT_BODY = ("camera", "optical", "gimbal", "lidar", "laser", "ned", "frd")
_NOT_DOWN = ("front", "forward", "rear", "back", "backward", "left", "right", "up", "upward")


class Definitions:
    def __init__(self, extra: str, what: str, distro: str = "") -> None:
        """`extra`, `what`: of the error where `rosbags` is missing. `distro` as in ROS_DISTRO
        ("humble"); one that is not known stands for the newest. Raises `MissingExtraError`."""
        typesys = needed("rosbags.typesys", extra, what)
        stores = {store.value: store for store in typesys.Stores}
        self._store = typesys.get_typestore(stores.get(f"ros2_{distro}", typesys.Stores.LATEST))
        for name, text in _GEOGRAPHIC.items():
            self._store.register(typesys.get_types_from_msg(text, name))

    def text(self, name: str) -> str:
        """The definition of a message, of those that it consists of too."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    def new(self, name: str, /, **values: Any) -> Any:
        """A message of the type `name` ("sensor_msgs/msg/NavSatFix")."""
        return self._store.types[name](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        return self.new("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def time(self, stamp_ns: int) -> Any:
        """Within its range: 1970 to 2038."""
        sec, nanosec = divmod(max(0, int(stamp_ns)), TIME_NS)
        return self.new("builtin_interfaces/msg/Time", sec=min(sec, 2**31 - 1), nanosec=nanosec)

    def vector(self, kind: str, names: str, values: Sequence[float]) -> Any:
        """A message of `geometry_msgs` of plain numbers, such as Point and Quaternion."""
        numbers = map(float, values)
        return self.new(f"geometry_msgs/msg/{kind}", **dict(zip(names, numbers, strict=True)))

    def navsatfix(
        self,
        header: Any,
        latlon_deg: tuple[float, float],
        cov_en_m2: NDArray[np.float64],
        altitude_m: float = math.nan,
        *,
        valid: bool = True,
    ) -> Any:
        """A position, status "no fix" unless `valid`; its altitude, NaN for unknown, is not
        measured, and the satellite service is 0."""
        covariance = np.diag([0.0, 0.0, NO_ALTITUDE_M2])
        covariance[:2, :2] = cov_en_m2
        return self.new(
            "sensor_msgs/msg/NavSatFix",
            header=header,
            status=self.new("sensor_msgs/msg/NavSatStatus", status=int(valid) - 1, service=0),
            latitude=float(latlon_deg[0]),
            longitude=float(latlon_deg[1]),
            altitude=altitude_m,
            position_covariance=covariance.ravel(),
            position_covariance_type=3,  # known
        )

    def decoded(self, name: str, cdr: bytes) -> Any:
        return self._store.deserialize_cdr(cdr, name)

    def encoded(self, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))


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
