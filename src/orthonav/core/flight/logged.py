"""The messages of a flight log, written and read.

A flight log is one or more MCAP files (`docs/flights.md`). Each message is JSON, so that it can be
read without orthonav. Images are the exception: base64 would hide their bytes from the compression
of the chunks, so they are encoded as in ROS 2 (CDR), and Foxglove knows the schema by name. Numbers
that JSON cannot express are the texts `NaN`, `Infinity` and `-Infinity`, as in the JSON of Protocol
Buffers; all others are read back bit for bit.
"""

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError, described
from orthonav.core.flight.fixes import INTEGRITY_KEYS
from orthonav.core.flight.folder import BROKEN, camera_from_plain
from orthonav.core.flight.gnss import GnssSample
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import Ground
from orthonav.core.records import Fix, Prior, Telemetry

PROFILE = "orthonav"  # profile in the header of an MCAP file that marks a flight log of orthonav
FORMAT = 1
MAX_CHUNK_BYTES = 128 * 2**20  # largest chunk, uncompressed; readers refuse those that claim more
MAX_PICTURE_BYTES = MAX_CHUNK_BYTES // 2
MAX_JSON_BYTES = 2**20
FRAME_ID = "camera"
PICTURES = ("full", "thumbnail", "none", "dropped", "bad")
"""State of a view's image: logged, logged small, not requested, dropped for lack of time or space,
or unusable as the camera delivered it."""

_WORDS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_NUMBER, _TEXT, _OBJECT = {"type": "number"}, {"type": "string"}, {"type": "object"}
_INTEGER = {"type": "integer"}


def _numbers(count: int | None = None) -> dict[str, Any]:
    sized = {} if count is None else {"minItems": count, "maxItems": count}
    return {"type": "array", "items": _NUMBER, **sized}


def _schema(title: str, required: Mapping[str, Any], optional: Mapping[str, Any]) -> str:
    schema = {"title": title, "type": "object", "properties": {**required, **optional}}
    return json.dumps({**schema, "required": list(required)})


@dataclass(frozen=True)
class Topic:
    """One kind of message: its name, its schema, and how schema and message are encoded."""

    name: str
    schema: str
    text: str
    schema_encoding: str = "jsonschema"
    encoding: str = "json"


_IMAGE = """builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_IMAGE_NAME = "foxglove_msgs/msg/CompressedImage"
_NAVSAT = """std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/NavSatStatus
int8 status
uint16 service
"""
_REPORTED = ("yaw_deg", "pitch_deg", "roll_deg", "agl_m")
_REPORTED_IF_KNOWN = tuple(each.name for each in fields(Telemetry) if each.type == float | None)

SESSION = Topic(
    "/orthonav/session",
    "orthonav.Session",
    _schema(
        "orthonav.Session",
        {"format": _INTEGER, "run": _TEXT, "version": _TEXT, "views": _TEXT, "camera": _OBJECT},
        {"map": _OBJECT, "options": _OBJECT},
    ),
)
VIEW = Topic("/orthonav/view", _IMAGE_NAME, _IMAGE, "ros2msg", "cdr")
THUMBNAIL = Topic("/orthonav/thumbnail", _IMAGE_NAME, _IMAGE, "ros2msg", "cdr")
TELEMETRY = Topic(
    "/orthonav/telemetry",
    "orthonav.Telemetry",
    _schema(
        "orthonav.Telemetry",
        {
            "timestamp": _TIME,
            "index": _INTEGER,
            "number": _INTEGER,
            "frame": _TEXT,
            "time_ns": _INTEGER,
            "picture": _TEXT,
            **dict.fromkeys(_REPORTED, _NUMBER),
        },
        {
            **dict.fromkeys(_REPORTED_IF_KNOWN, _NUMBER),
            "prior": _OBJECT,
            "below": _OBJECT,
            "vel_en_mps": _numbers(),
            "camera_latency_ms": _NUMBER,
            "withheld": {"type": "boolean"},
        },
    ),
)
RESULT = Topic(
    "/orthonav/result",
    "orthonav.Result",
    _schema(
        "orthonav.Result",
        {"frame": _TEXT, "time_s": _NUMBER, "status": _TEXT, "evidence": _OBJECT},
        {
            **dict.fromkeys(("lat_deg", "lon_deg", "confidence", "radius_m"), _NUMBER),
            **dict.fromkeys(("heading_deg", "agl_m", "latency_ms"), _NUMBER),
            **dict.fromkeys(INTEGRITY_KEYS, _NUMBER),
            **dict.fromkeys(("reason", "detail", "state"), _TEXT),
        },
    ),
)
POSITION = Topic(
    "/orthonav/position",
    "foxglove.LocationFix",
    _schema(
        "foxglove.LocationFix",
        {
            "timestamp": _TIME,
            "frame_id": _TEXT,
            "latitude": _NUMBER,
            "longitude": _NUMBER,
            "altitude": _NUMBER,
            "position_covariance": _numbers(9),
            "position_covariance_type": _INTEGER,
        },
        {},
    ),
)
NAVSAT = Topic("/orthonav/navsatfix", "sensor_msgs/msg/NavSatFix", _NAVSAT, "ros2msg", "cdr")
CAMERA = Topic(
    "/orthonav/camera",
    "foxglove.CameraCalibration",
    _schema(
        "foxglove.CameraCalibration",
        {"timestamp": _TIME, "frame_id": _TEXT, "width": _INTEGER, "height": _INTEGER},
        {
            "distortion_model": _TEXT,
            "D": _numbers(),
            "K": _numbers(9),
            "R": _numbers(9),
            "P": _numbers(12),
        },
    ),
)
GNSS = Topic("/orthonav/gnss", "sensor_msgs/msg/NavSatFix", _NAVSAT, "ros2msg", "cdr")
HEALTH = Topic("/orthonav/health", "orthonav.Health", _schema("orthonav.Health", {}, {}))
TOPICS = (SESSION, VIEW, THUMBNAIL, TELEMETRY, RESULT, POSITION, NAVSAT, GNSS, CAMERA, HEALTH)

NO_ALTITUDE_M2 = 1e8
"""Vertical variance of a position: a fix has no altitude, which is written as 0."""
_COVARIANCE_KNOWN = 3
_STATUS_FIX, _STATUS_NO_FIX = 0, -1


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
        return self.topic is VIEW


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
    """Strict JSON of plain values. Raises `ValueError` or `TypeError` for others."""
    return json.dumps(_worded(plain), allow_nan=False, separators=(",", ":")).encode("ascii")


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
    """The message of `TELEMETRY`."""
    telemetry = view.telemetry
    plain = {
        "timestamp": stamp(telemetry.time_ns),
        "index": int(view.index),
        "number": int(view.number),
        "frame": view.frame,
        "time_ns": int(telemetry.time_ns),
        "picture": view.picture,
        **{name: float(getattr(telemetry, name)) for name in _REPORTED},
        **{name: _float_or_none(getattr(telemetry, name)) for name in _REPORTED_IF_KNOWN},
        "prior": _floats(telemetry.prior),
        "vel_en_mps": telemetry.vel_en_mps and [float(value) for value in telemetry.vel_en_mps],
    }
    if telemetry.below is not None:
        plain["below"] = _floats(telemetry.below)
    if view.camera_latency_ms is not None:
        plain["camera_latency_ms"] = float(view.camera_latency_ms)
    if view.withheld:
        plain["withheld"] = True
    return to_json(plain)


def view_of(data: bytes) -> LoggedView:
    """The view in a message of `TELEMETRY`. Raises `FlightError`."""
    plain = from_json(data)
    try:
        velocity, latency = plain["vel_en_mps"], plain.get("camera_latency_ms")
        known = [name for name in _REPORTED_IF_KNOWN if plain.get(name) is not None]
        values: dict[str, Any] = {name: _number(plain[name]) for name in (*_REPORTED, *known)}
        telemetry = Telemetry(
            time_ns=_integer(plain["time_ns"]),
            **values,
            prior=_record(Prior, plain["prior"]),
            vel_en_mps=None if velocity is None else _pair(velocity),
            below=_record(Ground, plain.get("below")),
        )
        index, number = _integer(plain["index"]), _integer(plain["number"])
        frame, picture = plain["frame"], plain["picture"]
        latency_ms = None if latency is None else _number(latency)
        if not isinstance(frame, str) or picture not in PICTURES:
            raise ValueError("invalid frame or picture")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FlightError(f"telemetry of the log is damaged: {described(error)}") from error
    withheld = plain.get("withheld") is True
    return LoggedView(index, number, frame, telemetry, picture, latency_ms, withheld)


def camera_of(plain: Any) -> Camera:
    """Inverse of `Camera.numbers`. Raises `FlightError` or `CameraError`."""
    try:
        return camera_from_plain(plain)
    except CameraError:
        raise
    except BROKEN as error:
        raise FlightError(f"camera of the log is damaged: {described(error)}") from error


def calibration_message(camera: Camera, time_ns: int) -> bytes:
    """The message of `CAMERA`: principal point from the centre of the first pixel, as OpenCV."""
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


def position_message(fix: Fix, time_ns: int) -> bytes:
    """The message of `POSITION`; raises `ValueError` where a value is not finite."""
    (ee, en), (ne, nn) = fix.cov_en_m2.tolist()
    plain = {
        "timestamp": stamp(time_ns),
        "frame_id": FRAME_ID,
        "latitude": float(fix.lat_deg),
        "longitude": float(fix.lon_deg),
        "altitude": 0.0,
        "position_covariance": [ee, en, 0.0, ne, nn, 0.0, 0.0, 0.0, NO_ALTITUDE_M2],
        "position_covariance_type": _COVARIANCE_KNOWN,
    }
    return json.dumps(plain, allow_nan=False).encode("ascii")


def navsat_message(fix: Fix, time_ns: int, *, confident: bool) -> bytes:
    """The message of `NAVSAT` (CDR, little endian), status "no fix" unless `confident`.

    Raises `ValueError` where a value is not finite. The altitude is NaN, the
    convention for unknown.
    """
    place = float(fix.lat_deg), float(fix.lon_deg)
    return _navsat(place, fix.cov_en_m2.reshape(-1).tolist(), time_ns, valid=confident)


def gnss_message(sample: GnssSample, time_ns: int) -> bytes:
    """The message of `GNSS` (CDR, little endian) of a solution. Raises `ValueError` as above."""
    std_m = sample.std_m if math.isfinite(sample.std_m) else 0.0
    place = sample.lat_deg, sample.lon_deg
    return _navsat(place, [std_m**2, 0.0, 0.0, std_m**2], time_ns, valid=sample.has_fix)


def _navsat(
    place: tuple[float, float], cov_en_m2: Sequence[float], time_ns: int, *, valid: bool
) -> bytes:
    ee, en, ne, nn = cov_en_m2
    if not all(map(math.isfinite, (*place, ee, en, ne, nn))):
        raise ValueError("position is not finite")
    sec, nsec = divmod(max(0, int(time_ns)), 10**9)
    name = FRAME_ID.encode() + b"\0"
    out = bytearray(struct.pack("<III", sec & 0xFFFFFFFF, nsec, len(name)) + name)
    out += struct.pack("<b", _STATUS_FIX if valid else _STATUS_NO_FIX)
    out += bytes(-len(out) % 2) + struct.pack("<H", 0)  # no satellite service
    out += bytes(-len(out) % 8)
    out += struct.pack("<3d", *place, math.nan)
    out += struct.pack("<9d", ee, en, 0.0, ne, nn, 0.0, 0.0, 0.0, NO_ALTITUDE_M2)
    return b"\0\1\0\0" + bytes(out) + struct.pack("<B", _COVARIANCE_KNOWN)


def stamp(time_ns: int) -> dict[str, int]:
    """Seconds and nanoseconds since 1970, as Foxglove expects; 0 for earlier times."""
    sec, nsec = divmod(max(0, int(time_ns)), 10**9)
    return {"sec": sec, "nsec": nsec}


def picture_message(data: bytes, kind: str, time_ns: int) -> bytes:
    """The message of `VIEW` and `THUMBNAIL` (CDR, little endian): `data` encoded as `kind`."""
    sec, nsec = divmod(max(0, int(time_ns)), 10**9)
    out = bytearray(b"\0\1\0\0")
    out += struct.pack("<II", sec & 0xFFFFFFFF, nsec)
    for value in (FRAME_ID.encode() + b"\0", data, kind.encode() + b"\0"):
        out += bytes(-len(out) % 4)
        out += struct.pack("<I", len(value)) + value
    return bytes(out)


def picture_of(message: bytes) -> tuple[bytes, str]:
    """The encoded image in a message of `VIEW` and its format. Raises `FlightError`."""
    values, at = [], 12
    for _ in range(3):
        at += -at % 4
        length = int.from_bytes(message[at : at + 4], "little")
        value = message[at + 4 : at + 4 + length]
        if message[:4] != b"\0\1\0\0" or len(value) != length or at + 4 > len(message):
            raise FlightError("image of the log is damaged")
        values.append(value)
        at += 4 + length
    return values[1], values[2].rstrip(b"\0").decode("latin-1")


def _worded(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, Mapping):
        return {str(key): _worded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_worded(each) for each in value]
    return value


def _floats(record: Any) -> dict[str, float] | None:
    return record and {name: float(value) for name, value in asdict(record).items()}


def _record(kind: Any, plain: Any) -> Any:
    """Inverse of `_floats`."""
    return None if plain is None else kind(*(_number(plain[f.name]) for f in fields(kind)))


def _float_or_none(value: float | None) -> float | None:
    return None if value is None else float(value)


def _number(value: Any) -> float:
    if isinstance(value, str) and value in _WORDS:
        return _WORDS[value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r:.40} is not a number")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value!r:.40} is beyond float64")
    return number


def _integer(value: Any) -> int:
    if type(value) is not int or abs(value) >= 2**63:
        raise TypeError(f"{value!r:.40} is not an integer of 64 bits")
    return value


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return _number(first), _number(second)


_MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33  # magic and IHDR


def lossless_png(grey: NDArray[np.uint8]) -> bytes:
    """`grey` (H, W) uint8 as a PNG with row differences, not compressed.

    The log compresses its chunks, which suffices for differences: PNG's own compression would take
    ten times as long to save a few per cent. Raises `ValueError` for another array.
    """
    if grey.ndim != 2 or grey.dtype != np.uint8 or not grey.size:
        raise ValueError(f"expected grey levels (H, W) uint8, got {grey.dtype} {grey.shape}")
    height, width = grey.shape
    rows = np.empty((height, width + 1), dtype=np.uint8)
    rows[:, 0] = 2  # filter "up"
    rows[0, 1:] = grey[0]
    np.subtract(grey[1:], grey[:-1], out=rows[1:, 1:])  # modulo 256, as PNG defines it
    chunks = (
        (b"IHDR", _shape(width, height)),
        (b"IDAT", zlib.compress(rows.data, 0)),
        (b"IEND", b""),
    )
    return _MAGIC + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def grey_of_png(data: bytes, width_px: int, height_px: int, where: str) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of a PNG of this size; `where` is its location, for errors.

    The declared size is checked before anything is allocated. Raises `FlightError`.
    """
    expected = b"\0\0\0\rIHDR" + _shape(width_px, height_px)
    head = data[len(_MAGIC) : len(_MAGIC) + len(expected)]
    if not data.startswith(_MAGIC) or head != expected:
        raise FlightError(f"expected a grey PNG of {width_px} x {height_px} px: {where}")
    if data[_HEADER_BYTES + 4 : _HEADER_BYTES + 8] != b"IDAT":  # no profiles, no texts
        raise FlightError(f"image is not a PNG of a flight log: {where}")
    try:
        grey = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), int(cv2.IMREAD_GRAYSCALE))
    except cv2.error:
        grey = None
    if grey is None or grey.shape != (height_px, width_px) or grey.dtype != np.uint8:
        raise FlightError(f"image cannot be decoded: {where}")
    return np.asarray(grey, dtype=np.uint8)


def _shape(width_px: int, height_px: int) -> bytes:
    return struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)
