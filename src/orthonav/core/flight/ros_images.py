"""Images and cameras of ROS messages (sensor_msgs)."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight import decode_image
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.camera_files import camera_from_numbers

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
    """Grey levels (H, W) uint8 of a `sensor_msgs/Image`; 16-bit ones are scaled down.

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
    return np.asarray(pixels if width == 1 else pixels >> 8, dtype=np.uint8)


def camera_of_info(message: Any) -> Camera:
    """The camera of a `sensor_msgs/CameraInfo` (matrix K, not the rectified P).

    Raises `CameraError` where it is not calibrated, or has an unsupported model.
    """
    matrix = np.asarray(getattr(message, "K", getattr(message, "k", None)), dtype=np.float64)
    lens = np.asarray(getattr(message, "D", getattr(message, "d", None)), dtype=np.float64)
    if matrix.size != 9 or matrix[0] <= 0:
        raise CameraError("camera_info is not calibrated; give --camera FILE")
    roi = message.roi
    if message.binning_x > 1 or message.binning_y > 1 or roi.width or roi.height:
        raise CameraError("camera_info with binning or a region of interest; give --camera FILE")
    return camera_from_numbers(
        (message.width, message.height),
        matrix[[0, 4, 2, 5]].tolist(),
        lens.ravel().tolist(),
        str(message.distortion_model),
    )
