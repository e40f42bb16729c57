"""Flight folders, read and written."""

import csv
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from decimal import Decimal
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError, MissingFileError, OutputError
from orthonav.core.files import StrPath, path_of, require_file
from orthonav.core.flight.recording import RecordedView, fitted
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.records import (
    LEAST_COUNTS,
    NO_VALUE,
    Prior,
    Telemetry,
    grey_levels,
    spread,
    stretched,
)
from orthonav.core.tables import TableError, TableRows

TELEMETRY_COLUMNS = ("frame", "time_s", "yaw_deg", "pitch_deg", "roll_deg", "agl_m")
OPTIONAL_COLUMNS = (
    *("yaw_std_deg", "agl_std_m", "prior_lat_deg", "prior_lon_deg", "prior_std_m"),
    *("vel_east_mps", "vel_north_mps", "tilt_std_deg", "mount_std_deg"),
    *("vel_std_mps", "home_m", "amsl_m", "hae_m"),
)
_PRIOR_FIELDS = ("lat_deg", "lon_deg", "std_m")
_OPTIONAL_FIELDS = [each.name for each in fields(Telemetry) if each.name in OPTIONAL_COLUMNS]
MAX_TEXT_BYTES = 500_000_000
MAX_VIEWS = 1_000_000
"""Rows of a table of a flight: as many views as `simulate` makes, 55 hours at 5 Hz."""
BROKEN = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)


@dataclass(frozen=True)
class FlightFolder:
    """A flight as it was recorded: one camera, views in the order of the telemetry."""

    path: Path
    camera: Camera
    note: str
    views: tuple[RecordedView, ...]

    @property
    def expected(self) -> int:
        """Number of views."""
        return len(self.views)


def open_flight(path: StrPath, *, images_needed: bool = True) -> FlightFolder:
    """Open a flight folder and, if `images_needed`, check that every image named is there.

    The camera is scaled to the size of the first image that can be decoded. Raises
    `MissingFileError`, `FlightError` or `CameraError` with file and line. Values that are not
    numbers become NaN: a missing heading or height concerns one view only.
    """
    path = path_of(path, "flight folder")
    if not path.is_dir():
        kind = "is a file, not a folder" if path.exists() else "does not exist"
        raise MissingFileError(f"flight folder {kind}: {path}")
    camera, note = read_camera(path / "flight.json")
    telemetry = require_file(path / "telemetry.csv", "telemetry of the flight")
    views = tuple(_views(telemetry, path / "frames", images_needed))
    if not views:
        raise FlightError(f"telemetry has no views: {telemetry}")
    return FlightFolder(path, _fitted(camera, views), note, views)


def _fitted(camera: Camera, views: Iterable[RecordedView]) -> Camera:
    for view in views:
        try:
            height, width = view.grey().shape
        except (FlightError, MissingFileError):
            continue
        return fitted(camera, width, height, view.where)
    return camera


def read_image(path: Path) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of an image file, as `decode_image`.

    Raises `MissingFileError` or, where it cannot be decoded or was cut short, `FlightError`.
    """
    path = require_file(path, "image of the flight")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FlightError(
            f"image of the flight cannot be read ({error.strerror}): {path}"
        ) from error
    return decode_image(data, str(path))


def decode_image(data: bytes, where: str) -> NDArray[np.uint8]:
    """Grey levels (H, W) uint8 of an encoded image (JPEG, PNG, TIFF); `where` is for errors.

    16 bits as `grey_levels`; other numbers, such as temperatures, are stretched.

    Raises `FlightError` where it cannot be decoded or was cut short.
    """
    if _is_cut_jpeg(data):
        raise FlightError(f"image of the flight was cut short: {where}")
    # The camera describes the sensor: an orientation tag must not rotate the image.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise FlightError(f"image of the flight cannot be decoded: {where}")
    if image.dtype in (np.uint8, np.uint16):
        return grey_levels(image)
    return _measured(image)


def _measured(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey levels of temperatures (deg C), reflectances and other numbers. Real ones count as
    spread over 2.0 at least, those from 0 to 1 over 0.05."""
    if image.dtype.kind != "f":
        return stretched(image, spread(image), LEAST_COUNTS)
    known = np.where(np.abs(image) < NO_VALUE, image, np.nan)
    is_share = ((known >= 0) & (known <= 1) | np.isnan(known)).all()
    return stretched(known, spread(known), 0.05 if is_share else 2.0)


def _is_cut_jpeg(data: bytes) -> bool:
    """Whether this is a JPEG that lacks its end-of-image marker.

    OpenCV before 5 fills the missing part of a JPEG with grey without an error; incomplete PNG and
    TIFF it does not decode. The marker is searched after the header of the first scan: thumbnails
    before it end with a marker of their own, compressed data never holds one, and previews or
    padding after it do not matter.
    """
    if not data.startswith(b"\xff\xd8"):
        return False
    at = 2
    while data[at : at + 1] == b"\xff" and data[at : at + 2] != b"\xff\xda":  # start of scan
        filling = data[at + 1 : at + 2] == b"\xff"
        at += 1 if filling else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.find(b"\xff\xd9", at) < 0


def read_truth(path: StrPath) -> dict[str, tuple[float, float]]:
    """True positions by frame, (lat_deg, lon_deg), from `truth.csv`.

    Raises `MissingFileError` or `FlightError`, naming the line.
    """
    path = require_file(path, "ground truth")
    truth: dict[str, tuple[float, float]] = {}
    for line, row in csv_rows(path, ("frame", "lat_deg", "lon_deg")):
        lat, lon = number_of(row["lat_deg"]), number_of(row["lon_deg"])
        check_latlon(lat, lon, line, path)
        if row["frame"] in truth:
            raise FlightError(f"line {line}: frame {row['frame']} appears twice: {path}")
        truth[row["frame"]] = (lat, lon)
    return truth


def check_latlon(lat_deg: float, lon_deg: float, line: int, path: Path) -> None:
    """Raise `FlightError` unless a line of a table has a latitude and longitude."""
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360):  # NaN too
        hint = swapped_hint(lat_deg, lon_deg)
        raise FlightError(f"line {line}: not a latitude and longitude in degrees{hint}: {path}")


def read_camera(path: Path) -> tuple[Camera, str]:
    """Camera and note of a `flight.json`.

    Raises `MissingFileError`, `FlightError` or `CameraError`.
    """
    path = require_file(path, "camera of the flight")
    try:
        plain = json.loads(path.read_text(encoding="utf-8-sig"))
        return camera_from_plain(plain["camera"]), str(plain.get("note", ""))
    except CameraError as error:
        raise CameraError(f"{error}: {path}") from error
    except BROKEN as error:
        raise FlightError(
            "expected {camera: {width_px, height_px, fx_px, fy_px, cx_px, cy_px}} as JSON "
            f"({type(error).__name__}: {error}): {path}"
        ) from error


def camera_from_plain(raw: Any) -> Camera:
    """The camera of plain values as in `flight.json`; raises `CameraError` or one of `BROKEN`."""
    distortion = raw.get("distortion", [])
    if not isinstance(distortion, list):
        raise TypeError(f"distortion must be a list, got {distortion!r:.80}")
    return Camera(
        width_px=int(raw["width_px"]),
        height_px=int(raw["height_px"]),
        fx_px=float(raw["fx_px"]),
        fy_px=float(raw["fy_px"]),
        cx_px=float(raw["cx_px"]),
        cy_px=float(raw["cy_px"]),
        distortion=tuple(float(value) for value in distortion),
        model=str(raw.get("model", "brown")),
        focal_std=float(raw.get("focal_std", 0.0)),
        unusual=raw.get("unusual") is True,
    ).plausible()


def _views(telemetry: Path, frames: Path, images_needed: bool) -> Iterator[RecordedView]:
    seen: set[str] = set()
    for line, row in csv_rows(telemetry, TELEMETRY_COLUMNS):
        frame = row["frame"]
        pure = PurePosixPath(frame)
        if not frame or pure.is_absolute() or ".." in pure.parts or "\\" in frame:
            raise FlightError(f"line {line}: '{frame}' is not a name inside frames/: {telemetry}")
        if frame in seen:
            raise FlightError(f"line {line}: frame {frame} appears twice: {telemetry}")
        seen.add(frame)
        time_ns = time_ns_of(row["time_s"])
        if time_ns is None:
            raise FlightError(f"line {line}: time_s is not a time in seconds: {telemetry}")
        image = frames / frame
        if images_needed and not os.path.isfile(image):  # noqa: PTH113 - False for too long a name
            raise FlightError(
                f"telemetry line {line} names an image that does not exist (localize "
                f"--skip-bad-images goes on without it): {image}"
            )
        prior = number_of(row.get("prior_lat_deg")), number_of(row.get("prior_lon_deg"))
        if hint := swapped_hint(*prior):
            raise FlightError(f"line {line}: prior position is out of range{hint}: {telemetry}")
        load = partial(read_image, image)
        yield RecordedView(
            frame, _telemetry(row, time_ns), None, str(image), load, image.read_bytes
        )


def _telemetry(row: Mapping[str, str], time_ns: int) -> Telemetry:
    lat, lon, std_m = (_optional(row, f"prior_{name}") for name in _PRIOR_FIELDS)
    east, north = (_optional(row, f"vel_{name}_mps") for name in ("east", "north"))
    prior = None
    if lat is not None and lon is not None and std_m is not None:
        prior = Prior.known(lat, lon, std_m)
    values: dict[str, Any] = {name: number_of(row[name]) for name in TELEMETRY_COLUMNS[2:]}
    values |= {name: _optional(row, name) for name in _OPTIONAL_FIELDS}
    velocity = None if east is None or north is None else (east, north)
    return Telemetry(time_ns, **values, prior=prior, vel_en_mps=velocity)


def csv_rows(
    path: Path, needed: tuple[str, ...], most_rows: int | None = None, *, short: bool = False
) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and fields of each row of a CSV that must have the columns `needed`; it has at
    most `most_rows`, by default `MAX_VIEWS`. `short`: whether missing fields at the end of a row
    are empty instead of an error."""
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise FlightError(f"file is larger than {MAX_TEXT_BYTES // 10**6} MB: {path}")
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = TableRows(stream, most_rows=most_rows or MAX_VIEWS)
            missing = [name for name in needed if name not in rows.columns]
            if missing:
                held = f"{','.join(rows.columns)!r:.80}"
                raise FlightError(f"columns are missing: {', '.join(missing)}; got {held}: {path}")
            for row in rows:
                if not short and any(row[name] is None for name in needed):
                    raise FlightError(f"line {rows.line} has too few fields: {path}")
                yield rows.line, {k: v or "" for k, v in row.items()}
    except TableError as error:
        raise FlightError(f"{error}: {path}") from error


def time_ns_of(text: str | None) -> int | None:
    """Nanoseconds of decimal seconds, None where the text is not a time.

    Decimal, because a float64 of seconds since 1970 does not resolve nanoseconds.
    """
    if text is None or not abs(number_of(text)) < 9e9:  # NaN too
        return None
    try:
        return round(Decimal(text.strip()) * 10**9)
    except ArithmeticError:  # 1e-99999999999999999999, which is 0 as a float
        return None


def number_of(text: Any) -> float:
    """The number in a field of a table, NaN where it is not a number."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return math.nan


def _optional(row: Mapping[str, str], name: str) -> float | None:
    value = number_of(row.get(name, ""))
    return value if math.isfinite(value) else None


class FlightWriter:
    """Writes views into an existing empty folder; `close` writes telemetry, camera and truth.

    Use it inside `orthonav.core.files.replacing_folder`, so that it is written whole or not at all.
    """

    def __init__(
        self, folder: Path, camera: Camera, note: str, choices: Sequence[str] = ()
    ) -> None:
        self._folder = Path(folder)
        self._camera = camera
        self._note = note
        self._choices = choices
        self._rows: list[dict[str, Any]] = []
        self._truth: list[tuple[str, str, str]] = []
        (self._folder / "frames").mkdir()

    def add(
        self,
        frame: str,
        image: NDArray[np.uint8],
        telemetry: Telemetry,
        truth_latlon_deg: tuple[float, float],
        jpeg_quality: int = 90,
    ) -> None:
        """Add one view: `image` (H, W, 3) RGB, JPEG or PNG by the ending of `frame`."""
        data = encoded(np.ascontiguousarray(image[..., ::-1]), frame, jpeg_quality)
        self.add_encoded(frame, data, telemetry, truth_latlon_deg)

    def add_encoded(
        self,
        frame: str,
        data: bytes,
        telemetry: Telemetry,
        truth_latlon_deg: tuple[float, float] | None,
    ) -> None:
        """Add one view whose image is encoded already, as `data`; its truth where known."""
        path = self._folder / "frames" / frame
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        self._rows.append({"frame": frame, **_columns(telemetry)})
        if truth_latlon_deg is not None:
            lat, lon = truth_latlon_deg
            self._truth.append((frame, f"{lat:.8f}", f"{lon:.8f}"))

    def close(self) -> None:
        """Write `telemetry.csv`, `flight.json` and, where any is known, `truth.csv`."""
        used = [
            name for name in OPTIONAL_COLUMNS if any(row[name] is not None for row in self._rows)
        ]
        columns = [*TELEMETRY_COLUMNS, *used]
        table = [[_text(row[name]) for name in columns] for row in self._rows]
        _write_csv(self._folder / "telemetry.csv", columns, table)
        if self._truth:
            _write_csv(self._folder / "truth.csv", ("frame", "lat_deg", "lon_deg"), self._truth)
        plain = {"camera": self._camera.numbers(), "note": self._note}
        text = json.dumps(plain | ({"choices": self._choices} if self._choices else {}), indent=1)
        (self._folder / "flight.json").write_text(text + "\n", encoding="utf-8")


def encoded(image: NDArray[np.uint8], frame: str, jpeg_quality: int = 90) -> bytes:
    """`image` (H, W) grey or (H, W, 3) BGR encoded by the ending of `frame`.

    Raises `OutputError` where OpenCV cannot encode it.
    """
    options = [int(cv2.IMWRITE_JPEG_QUALITY), jpeg_quality]
    if not frame.lower().endswith((".jpg", ".jpeg")):
        options = []
    done, data = cv2.imencode(Path(frame).suffix, image, options)
    if not done:
        raise OutputError(f"image cannot be encoded: {frame}")
    return data.tobytes()


def _columns(telemetry: Telemetry) -> dict[str, Any]:
    prior, velocity = telemetry.prior, telemetry.vel_en_mps
    return {
        "time_s": Decimal(telemetry.time_ns) / 10**9,
        **{name: getattr(telemetry, name) for name in (*TELEMETRY_COLUMNS[2:], *_OPTIONAL_FIELDS)},
        **{f"prior_{name}": prior and getattr(prior, name) for name in _PRIOR_FIELDS},
        "vel_east_mps": velocity and velocity[0],
        "vel_north_mps": velocity and velocity[1],
    }


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, Decimal):
        return f"{value:.9f}".rstrip("0").rstrip(".")
    return f"{value:.8f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
