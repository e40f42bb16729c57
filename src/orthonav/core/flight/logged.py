"""The messages of a flight log, written and read.

A flight log is one or more MCAP files (`docs/flights.md`). Images and positions are messages of ROS
2 (CDR, by `rosbags`); all others are JSON, so that they can be read without orthonav. Numbers that
JSON cannot express are the texts `NaN`, `Infinity` and `-Infinity`, as in the JSON of Protocol
Buffers; all others are read back bit for bit.
"""

import json
import math
import struct
from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError, MissingExtraError, described
from orthonav.core.flight.fixes import INTEGRITY_KEYS
from orthonav.core.flight.folder import BROKEN, camera_from_plain
from orthonav.core.flight.gnss import GnssSample
from orthonav.core.flight.ros_messages import Definitions
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.records import Fix, Prior, Telemetry

PROFILE = "orthonav"  # profile in the header of an MCAP file that marks a flight log of orthonav
FORMAT = 2  # of the messages; 1 had images as foxglove_msgs/CompressedImage
MAX_CHUNK_BYTES = 128 * 2**20  # largest chunk, uncompressed; readers refuse those that claim more
MAX_PICTURE_BYTES = MAX_CHUNK_BYTES // 2
MAX_JSON_BYTES = 2**20
FRAME_ID = "camera"
PICTURES = ("full", "thumbnail", "none", "dropped", "bad")
"""State of a view's image: logged, logged small, not requested or not encodable, dropped for lack
of time or space, or unusable as the camera delivered it."""
_REPORTED = ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")
_OPTIONAL = tuple(each.name for each in fields(Telemetry) if each.type == float | None)


@cache
def _ros() -> Definitions:
    return Definitions("autopilot", "a flight log")


@dataclass(frozen=True)
class Topic:
    """One kind of message. `names`: the fields of a JSON message by their type."""

    name: str
    schema: str
    names: tuple[tuple[str, str], ...] = ()

    @property
    def is_ros(self) -> bool:
        """Whether its messages are of ROS 2, encoded as CDR; else they are JSON."""
        return "/msg/" in self.schema

    def definition(self) -> str:
        """Its schema: the definition of the ROS message, or a JSON schema."""
        if self.is_ros:
            return _ros().text(self.schema)
        properties = {name: _JSON_TYPES[kind] for kind, text in self.names for name in text.split()}
        return json.dumps({"title": self.schema, "type": "object", "properties": properties})


_INTEGER = {"type": "integer"}
_JSON_TYPES: dict[str, Any] = {
    **{kind: {"type": kind} for kind in ("number", "integer", "string", "object", "boolean")},
    "numbers": {"type": "array", "items": {"type": "number"}},
    "time": {
        "type": "object",
        "title": "time",
        "properties": {"sec": _INTEGER, "nsec": _INTEGER},
    },
}


@dataclass(frozen=True)
class Topics:
    """All topics of a log, by what they carry."""

    session: Topic = Topic(
        "/orthonav/session",
        "orthonav.Session",
        (("integer", "format"), ("string", "run version views"), ("object", "camera map options")),
    )
    view: Topic = Topic("/orthonav/view", "sensor_msgs/msg/CompressedImage")
    thumbnail: Topic = Topic("/orthonav/thumbnail", "sensor_msgs/msg/CompressedImage")
    telemetry: Topic = Topic(
        "/orthonav/telemetry",
        "orthonav.Telemetry",
        (
            ("time", "timestamp"),
            ("integer", "index number time_ns"),
            ("string", "frame picture"),
            ("number", " ".join((*_REPORTED, *_OPTIONAL, "camera_latency_ms"))),
            ("object", "prior below"),
            ("numbers", "vel_en_mps"),
            ("boolean", "withheld"),
        ),
    )
    result: Topic = Topic(
        "/orthonav/result",
        "orthonav.Result",
        (
            ("string", "frame status reason detail state"),
            ("number", "time_s lat_deg lon_deg confidence radius_m heading_deg agl_m latency_ms"),
            ("number", " ".join(INTEGRITY_KEYS)),
            ("object", "evidence"),
        ),
    )
    navsat: Topic = Topic("/orthonav/navsatfix", "sensor_msgs/msg/NavSatFix")
    gnss: Topic = Topic("/orthonav/gnss", "sensor_msgs/msg/NavSatFix")
    camera: Topic = Topic(
        "/orthonav/camera",
        "foxglove.CameraCalibration",
        (
            ("time", "timestamp"),
            ("string", "frame_id distortion_model"),
            ("integer", "width height"),
            ("numbers", "D K R P"),
        ),
    )
    health: Topic = Topic("/orthonav/health", "orthonav.Health")


TOPICS = Topics()


@dataclass(frozen=True)
class Message:
    """A message of the log. `time_ns`: time of exposure. `index`: index of the view."""

    topic: Topic
    time_ns: int
    data: bytes
    index: int = 0

    @property
    def is_view(self) -> bool:
        """Whether it is a full image, which is dropped first where space is short."""
        return self.topic is TOPICS.view


@dataclass(frozen=True)
class LoggedView:
    """A view in a log."""

    index: int  # number in the log, from 0 without gaps; the sequence number of all its messages
    number: int  # number that the runner gave it, which counts skipped images too
    frame: str  # its name
    telemetry: Telemetry  # telemetry of its exposure
    picture: str  # state of its image, one of `PICTURES`
    camera_latency_ms: float | None = None
    """Latency that was subtracted from its arrival; None where the exposure was known."""
    withheld: bool = False
    """Whether it was not located because the latency of the camera was not known."""


def to_json(plain: Any) -> bytes:
    """Strict JSON of plain values and numbers. Raises `ValueError` or `TypeError` for others."""
    text = json.dumps(_strict(plain), default=_number_of, allow_nan=False, separators=(",", ":"))
    return text.encode("ascii")


def _strict(plain: Any) -> Any:
    """With texts in place of numbers that JSON cannot express."""
    if isinstance(plain, dict):
        return {key: _strict(value) for key, value in plain.items()}
    if isinstance(plain, list | tuple):
        return [_strict(value) for value in plain]
    if isinstance(plain, float) and not math.isfinite(plain):
        return "NaN" if math.isnan(plain) else "Infinity" if plain > 0 else "-Infinity"
    return plain


def _number_of(value: Any) -> Any:
    """Of NumPy. Raises `ValueError` or `TypeError` for other values."""
    return _strict(float(value))


def from_json(data: bytes) -> dict[str, Any]:
    """The object that `to_json` wrote; texts for numbers stay texts. Raises `FlightError`."""
    if len(data) > MAX_JSON_BYTES:
        raise FlightError(f"message of the log has {len(data)} bytes")
    try:
        plain = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise FlightError(f"message of the log is not JSON ({error})") from error
    if not isinstance(plain, dict):
        raise FlightError("message of the log is not a JSON object")
    return plain


def telemetry_message(view: LoggedView) -> bytes:
    """The message of `Topics.telemetry`."""
    plain = {
        "timestamp": stamp(view.telemetry.time_ns),
        "index": int(view.index),
        "number": int(view.number),
        "frame": view.frame,
        "picture": view.picture,
        **asdict(view.telemetry),
        "time_ns": int(view.telemetry.time_ns),
    }
    if view.camera_latency_ms is not None:
        plain["camera_latency_ms"] = view.camera_latency_ms
    if view.withheld:
        plain["withheld"] = True
    return to_json(plain)


def view_of(data: bytes) -> LoggedView:
    """The view in a message of `Topics.telemetry`. Raises `FlightError`."""
    plain = from_json(data)
    try:
        time_ns, index, number = (plain[name] for name in ("time_ns", "index", "number"))
        if not all(type(each) is int and abs(each) < 2**63 for each in (time_ns, index, number)):
            raise TypeError("time_ns, index or number is not an integer of 64 bits")
        known = [name for name in _OPTIONAL if plain.get(name) is not None]
        velocity, latency = plain["vel_en_mps"], plain.get("camera_latency_ms")
        telemetry = Telemetry(
            time_ns,
            **{name: _number(plain[name]) for name in (*_REPORTED, *known)},
            prior=_record(Prior, plain["prior"]),
            vel_en_mps=None if velocity is None else _pair(velocity),
            below=_record(Ground, plain.get("below")),
        )
        frame, picture = plain["frame"], plain["picture"]
        latency_ms = None if latency is None else _number(latency)
        if not isinstance(frame, str) or picture not in PICTURES:
            raise ValueError("invalid frame or picture")
    except BROKEN as error:
        raise FlightError(f"telemetry of the log is damaged: {described(error)}") from error
    withheld = plain.get("withheld") is True
    return LoggedView(index, number, frame, telemetry, picture, latency_ms, withheld)


def _record(kind: Any, plain: Any) -> Any:
    return None if plain is None else kind(*(_number(plain[each.name]) for each in fields(kind)))


def _number(value: Any) -> float:
    """Inverse of `to_json` for one number. Raises `TypeError` or `ValueError` for other values."""
    if value in ("NaN", "Infinity", "-Infinity"):
        return float(value)
    if type(value) not in (int, float) or not math.isfinite(value):
        raise TypeError(f"{value!r:.40} is not a number of float64")
    return float(value)


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return _number(first), _number(second)


def camera_of(plain: Any) -> Camera:
    """Inverse of `Camera.numbers`. Raises `FlightError` or `CameraError`."""
    try:
        return camera_from_plain(plain)
    except CameraError:
        raise
    except BROKEN as error:
        raise FlightError(f"camera of the log is damaged: {described(error)}") from error


def calibration_message(camera: Camera, time_ns: int) -> bytes:
    """The message of `Topics.camera`; the principal point counts from a pixel's centre."""
    cx, cy = camera.cx_px - 0.5, camera.cy_px - 0.5
    rows = [camera.fx_px, 0.0, cx], [0.0, camera.fy_px, cy], [0.0, 0.0, 1.0]
    fisheye = camera.model == "fisheye"
    lens = [float(value) for value in camera.distortion]
    plain = {
        "timestamp": stamp(time_ns),
        "frame_id": FRAME_ID,
        "width": camera.width_px,
        "height": camera.height_px,
        "distortion_model": "kannala_brandt" if fisheye else "plumb_bob",
        "D": lens + [0.0] * ((4 if fisheye else 5) - len(lens)),
        "K": [value for row in rows for value in row],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [value for row in rows for value in (*row, 0.0)],
    }
    return to_json(plain)


def navsat_message(fix: Fix, time_ns: int, *, confident: bool) -> bytes:
    """The message of `Topics.navsat`, status "no fix" unless `confident`.

    Raises `ValueError` where a value is not finite. The altitude is NaN, the convention for
    unknown.
    """
    return _navsat((fix.lat_deg, fix.lon_deg), fix.cov_en_m2, time_ns, valid=confident)


def gnss_message(sample: GnssSample, time_ns: int) -> bytes:
    """The message of `Topics.gnss` of a solution. Raises `ValueError` as above."""
    std_m = sample.std_m if math.isfinite(sample.std_m) else 0.0
    place = sample.lat_deg, sample.lon_deg
    return _navsat(place, np.eye(2) * std_m**2, time_ns, valid=sample.has_fix)


def _navsat(
    place: tuple[float, float], cov_en_m2: NDArray[np.float64], time_ns: int, *, valid: bool
) -> bytes:
    if not (np.isfinite(place).all() and np.isfinite(cov_en_m2).all()):
        raise ValueError("position is not finite")
    header = _ros().header(time_ns, FRAME_ID)
    return _ros().encoded(_ros().navsatfix(header, place, cov_en_m2, valid=valid))


def stamp(time_ns: int) -> dict[str, int]:
    """Seconds and nanoseconds since 1970, as Foxglove expects; 0 for earlier times."""
    sec, nsec = divmod(max(0, int(time_ns)), 10**9)
    return {"sec": sec, "nsec": nsec}


def picture_message(data: bytes, kind: str, time_ns: int) -> bytes:
    """The message of `Topics.view` and `Topics.thumbnail`: `data` encoded as `kind`."""
    header, pixels = _ros().header(time_ns, FRAME_ID), np.frombuffer(data, dtype=np.uint8)
    return _ros().encoded(_ros().new(TOPICS.view.schema, header=header, format=kind, data=pixels))


def picture_of(message: bytes) -> tuple[bytes, str]:
    """The encoded image in a message of `Topics.view` and its format. Raises `FlightError`."""
    try:
        found = _ros().decoded(TOPICS.view.schema, message)
    except MissingExtraError:
        raise
    except Exception as error:  # of the library, about damaged data
        raise FlightError("image of the log is damaged") from error
    return found.data.tobytes(), str(found.format)


_MAGIC = b"\x89PNG\r\n\x1a\n"


def lossless_png(grey: NDArray[np.uint8]) -> bytes:
    """`grey` (H, W) uint8 as a PNG that is not compressed, because the log compresses its chunks.
    Raises `ValueError` for another array."""
    if grey.ndim != 2 or grey.dtype != np.uint8 or not grey.size:
        raise ValueError(f"expected grey levels (H, W) uint8, got {grey.dtype} {grey.shape}")
    _, data = cv2.imencode(".png", grey, [int(cv2.IMWRITE_PNG_COMPRESSION), 0])
    return data.tobytes()


def grey_of_png(data: bytes, width_px: int, height_px: int, where: str) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of a PNG of this size; `where` is its location, for errors.

    The declared size is checked before anything is allocated. Raises `FlightError`.
    """
    shape = struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)
    if not data.startswith(_MAGIC + b"\0\0\0\rIHDR" + shape):
        raise FlightError(f"expected a grey PNG of {width_px} x {height_px} px: {where}")
    if data[37:41] != b"IDAT":  # no profiles, no texts
        raise FlightError(f"image is not a PNG of a flight log: {where}")
    try:
        grey = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), int(cv2.IMREAD_GRAYSCALE))
    except cv2.error:
        grey = None
    if grey is None or grey.shape != (height_px, width_px) or grey.dtype != np.uint8:
        raise FlightError(f"image cannot be decoded: {where}")
    return np.asarray(grey, dtype=np.uint8)
