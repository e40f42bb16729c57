"""A table of images by file name: a CSV beside a folder of images.

Columns are found by their names, case and units aside. A pitch near -90 is that of a gimbal as DJI
counts it, where -90 looks straight down; any other is in the convention of orthonav.
"""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.flight.folder import check_latlon, number_of
from orthonav.core.geo.attitude import enu_from_gimbal_camera
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.headings import RADIANS, seem_radians
from orthonav.core.tables import MAX_LINE_CHARS, TableError, TableRows
from orthonav.core.tilt import ASSUMED, GIMBAL, UNRECORDED, UNSTATED, TiltSource
from orthonav.ground.recordings.telemetry_track import LATEST_NS, measured

MAX_BYTES = 100_000_000
_SUFFIXES = (".csv", ".tsv", ".txt")
_SYNONYMS = {
    "file": ("file", "filename", "image", "sourcefile", "frame", "imagename", "label", "photo"),
    "yaw": ("gimbalyaw", "yaw", "heading"),
    "body_yaw": ("yaw", "heading"),
    "pitch": ("gimbalpitch", "pitch"),
    "roll": ("gimbalroll", "roll"),
    "agl": ("agl", "height"),
    "home": ("home", "relativealtitude"),
    "amsl": ("amsl",),
    "hae": ("hae",),
    "alt": ("altitude", "zaltitude"),
    "lat": ("lat", "latitude", "ylatitude"),
    "lon": ("lon", "longitude", "xlongitude"),
    "time": ("time", "timestamp", "datetimeoriginal"),
}
_BRACKETS = re.compile(r"[(\[]([^()\[\]]*)[)\]]")
_SCALES = dict.fromkeys(("ft", "feet", "foot"), 0.3048) | {"km": 1000.0, "cm": 0.01}
_SCALES |= dict.fromkeys(("rad", "radian", "radians"), math.degrees(1.0))
_UNITS = ("deg", "degree", "degrees", "m", "meter", "meters", "metre", "metres", "s", *_SCALES)
_UNREAD = re.compile(r"omega|phi|kappa|q[wxyz]")
_EMPTY = ("", "-", "nan", "na", "n/a", "none", "null")
_HEIGHTS = ("agl", "home", "amsl", "hae", "alt")
Columns = Mapping[str, tuple[str, float]]  # name in the table and scale, by field
ImageRow = Mapping[str, Any]  # what a table says of an image: fields of `Photo` by their names


@dataclass(frozen=True)
class ImageTable:
    """The rows of a table by the paths of images as it writes them, and warnings about them."""

    path: Path
    rows: Mapping[str, ImageRow]
    warnings: tuple[str, ...]

    def row(self, name: str) -> ImageRow | None:
        """The row of an image by its path below the folder, with or without its suffix; None where
        there is none, or several.

        Tables and folders begin at different levels, so the shorter path must be the end of the
        other one.
        """
        image = f"/{name.lower()}"
        fitting = [
            path
            for end in {image, str(PurePosixPath(image).with_suffix(""))}
            for path in self._by_name.get(PurePosixPath(end).name, ())
            if end.endswith(f"/{path}") or f"/{path}".endswith(end)
        ]
        if image[1:] in fitting:
            return self.rows[image[1:]]
        return self.rows[fitting[0]] if len(fitting) == 1 else None

    @cached_property
    def _by_name(self) -> Mapping[str, list[str]]:
        found: defaultdict[str, list[str]] = defaultdict(list)
        for path in self.rows:
            found[PurePosixPath(path).name].append(path)
        return found


def is_image_table(path: Path) -> bool:
    """Whether a file is a CSV with a column of file names and others that a view needs."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    found = _columns([name.strip().strip('"') for name in re.split(r"[,;\t]", _header(path))])
    return "file" in found and len(found) > 1


def names_images(path: Path, names: Collection[str]) -> bool:
    """Whether a text file names some of these images (in lower case)."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    with path.open("rb") as stream:
        text = stream.read(64_000).decode("utf-8", errors="replace").lower()
    return not set(re.split(r"[\s,;\"/\\]+", text)).isdisjoint(names)


def _header(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline(MAX_LINE_CHARS).decode("utf-8-sig", errors="replace")


def read_image_table(path: Path) -> ImageTable:
    """The table of a CSV with comma, semicolon or tab. Raises `FlightError`, with the line."""
    if path.stat().st_size > MAX_BYTES:
        raise FlightError(f"file is larger than {MAX_BYTES // 10**6} MB: {path}")
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            delimiter = max(",;\t", key=_header(path).count)
            table = TableRows(stream, delimiter=delimiter)
            columns = _columns(table.columns)
            named = list(columns.items())
            if "file" not in columns or len(columns) == 1:
                held = ", ".join(table.columns)
                raise FlightError(
                    "table needs a column of file names (file, image, filename) and others, such "
                    f"as yaw, pitch, roll, agl, lat, lon, time; it has {held:.200}: {path}"
                )
            lines = [
                (table.line, {key: (row.get(name) or "").strip() for key, (name, _) in named})
                for row in table
            ]
    except TableError as error:
        raise FlightError(f"{error}: {path}") from error
    comma = delimiter != ","
    found = [_numbers(texts, columns, line, comma, path) for line, texts in lines]
    source = _tilt_source(columns, found)
    if source is ASSUMED and not any(values.get("yaw") for values in found):
        # The heading of the gimbal was not recorded either: that of the aircraft counts.
        turns = any(values.get("body_yaw") for values in found)
        for values in found:
            values["yaw"] = values.get("body_yaw", math.nan) if turns else math.nan
    rows: dict[str, ImageRow] = {}
    for order, ((line, texts), values) in enumerate(zip(lines, found, strict=True)):
        name = str(PurePosixPath(texts["file"].replace("\\", "/").lower()))
        if name in rows:
            raise FlightError(f"table names {texts['file']!r:.80} twice: {path}")
        if texts["file"]:
            time_ns = _time_ns(texts.get("time", ""), line, path)
            rows[name] = _row(order, values, time_ns, source)
    if not rows:
        raise FlightError(f"table names no image: {path}")
    doubts = _doubts(columns, table.columns, found, source)
    return ImageTable(path, rows, tuple(f"{doubt}: {path}" for doubt in doubts))


def _columns(names: Sequence[str]) -> dict[str, tuple[str, float]]:
    spelt = {_plain(name): name for name in reversed(names)}
    found = {}
    for field, synonyms in _SYNONYMS.items():
        name = next((spelt[each] for each in synonyms if each in spelt), None)
        if name is not None:
            found[field] = name, _scale(name)
    pitch, roll = (found.get(name, ("", 0.0))[0].lower() for name in ("pitch", "roll"))
    if "gimbal" in pitch and "gimbal" not in roll:  # that of the aircraft
        found.pop("roll", None)
    return found


def _plain(name: str) -> str:
    words = re.findall(r"[a-z0-9]+", _BRACKETS.sub("", name.lower()))
    if len(words) > 1 and words[-1] in _UNITS:
        words.pop()
    return "".join(words).removesuffix("degree")


def _scale(name: str) -> float:
    bracket = _BRACKETS.search(name.lower())
    words = re.findall(r"[a-z]+", bracket[1] if bracket else name.lower())
    return next((_SCALES[word] for word in words if word in _SCALES), 1.0)


def _numbers(
    texts: Mapping[str, str], columns: Columns, line: int, comma: bool, path: Path
) -> dict[str, float]:
    values = {}
    for field, (name, scale) in columns.items():
        text = texts[field]
        if field in ("file", "time") or text.lower() in _EMPTY:
            continue
        if comma and "." not in text:
            text = text.replace(",", ".")
        value = number_of(text)
        if not math.isfinite(value):
            raise FlightError(f"line {line}: {name} is not a number, got {text!r:.40}: {path}")
        values[field] = measured(scale * value) if field in _HEIGHTS else scale * value
    lat, lon = values.get("lat", math.nan), values.get("lon", math.nan)
    if not math.isnan(lat + lon):
        check_latlon(lat, lon, line, path)
    return values


def _tilt_source(columns: Columns, rows: Sequence[Mapping[str, float]]) -> TiltSource:
    """What pitch and roll are of: `GIMBAL`; `ASSUMED`: of one that reports 0 in all rows, where it
    would look at the horizon; else `UNSTATED`."""
    known = [values["pitch"] for values in rows if "pitch" in values]
    # No camera that is of use looks back by more than 45 deg.
    if not known or (not _names_gimbal(columns) and float(np.median(known)) > -45.0):
        return UNSTATED
    return GIMBAL if any(known) or any(values.get("roll") for values in rows) else ASSUMED


def _names_gimbal(columns: Columns) -> bool:
    return "gimbal" in columns["pitch"][0].lower()


def _row(
    order: int, values: Mapping[str, float], time_ns: int | None, source: TiltSource
) -> ImageRow:
    found: dict[str, Any] = {"order": order}
    if time_ns is not None:
        found |= {"time_ns": time_ns, "zone_known": True}
    if "lat" in values and "lon" in values and (values["lat"] or values["lon"]):
        found["latlon_deg"] = values["lat"], values["lon"]
    stated = [name for name in _HEIGHTS if math.isfinite(values.get(name, math.nan))]
    found |= {f"{name}_m": values[name] for name in stated}
    yaw, pitch = values.get("yaw", math.nan), values.get("pitch", math.nan)
    roll = values.get("roll", 0.0)
    if source is GIMBAL and math.isfinite(pitch):
        known = math.isfinite(yaw)
        turned = attitude_of(enu_from_gimbal_camera((yaw if known else 0.0, pitch, roll)))
        yaw, pitch, roll = (turned[0] if known else math.nan), turned[1], turned[2]
    pose: dict[str, Any] = {}
    if math.isfinite(pitch):
        pose |= {"pitch_deg": pitch, "roll_deg": roll, **source.stated(aided=False)}
    if math.isfinite(yaw):
        pose |= {"yaw_deg": yaw % 360, "yaw_std_deg": None}
    return found | {"pose": pose}


def _time_ns(text: str, line: int, path: Path) -> int | None:
    """Nanoseconds of seconds, of milliseconds since 1970, or of a date; UTC where no zone."""
    if text.lower() in _EMPTY:
        return None
    try:
        if math.isfinite(number_of(text)):
            seconds = Decimal(text)
            while abs(seconds) > 9e9:  # milliseconds or less since 1970
                seconds /= 1000
            return round(seconds * 10**9)
        return ns_of(moment_of(text))
    except (ValueError, ArithmeticError) as error:
        raise FlightError(
            f"line {line}: time must be seconds or a date such as 2024-05-01T10:00:00Z, got "
            f"{text!r:.40}: {path}"
        ) from error


def moment_of(text: str) -> datetime:
    """A date and time as of ISO 8601 or EXIF (2024:05:01 10:00:00). Raises `ValueError`."""
    return datetime.fromisoformat(re.sub(r"^(\d{4}):(\d\d):(\d\d)", r"\1-\2-\3", text))


def ns_of(moment: datetime) -> int:
    """Nanoseconds since 1970 of a time, UTC without a zone. Raises `ValueError` beyond 64 bits."""
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    time_ns = round(moment.replace(microsecond=0).timestamp()) * 10**9 + moment.microsecond * 1000
    if abs(time_ns) >= LATEST_NS:
        raise ValueError(f"a time in the year {moment.year}")
    return time_ns


def _doubts(
    columns: Columns, held: list[str], rows: list[dict[str, float]], source: TiltSource
) -> Iterator[str]:
    lacks = [] if "yaw" in columns else ["heading (yaw or heading)"]
    lacks += [] if set(_HEIGHTS) & columns.keys() else ["height (agl or height)"]
    if lacks:
        yield f"table has no column of {' and of '.join(lacks)}"
    if unread := [name for name in held if _UNREAD.fullmatch(_plain(name))]:
        yield f"columns {', '.join(unread)} are not read"
    if seem_radians([values.get("yaw", math.nan) for values in rows]):
        yield RADIANS
    if source is ASSUMED:
        yield UNRECORDED
    elif source is GIMBAL and not _names_gimbal(columns):
        yield "pitch is near -90, so it is taken as that of a gimbal, where -90 looks straight down"
