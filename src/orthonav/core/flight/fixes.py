"""`fixes.jsonl`, written and read: one JSON object per view, in order of the flight.

The keys of a line and their order are those of `KEYS`, then of a fix `INTEGRITY_KEYS`,
`GROUND_KEYS` where the ground seen is known, `POSE_KEYS` where the attitude is, and `TRACK_KEYS` in
a track.
Unknown numbers (NaN, infinite) are written as null and read as NaN. `time_s` is written with up to
nine decimals, so that nanoseconds since 1970 are exact, which a float64 of seconds cannot hold.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from decimal import Decimal
from importlib import import_module
from itertools import chain, repeat
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import ArgumentError, FlightError, MissingExtraError
from orthonav.core.files import StrPath, require_file, write_lines
from orthonav.core.flight.recording import RecordedView
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.records import Fix, NoFix, TelemetryBias, ViewResult

KEYS = (
    "frame",  # name of the image in the flight folder
    "time_s",  # time of exposure
    "status",  # "fix" or "no_fix"
    "confident",  # false: the position is the best guess; null for no_fix, like all down to agl_m
    "lat_deg",  # WGS84
    "lon_deg",
    "cov_en_m2",  # [[east-east, east-north], [north-east, north-north]]
    "confidence",  # probability that the error is below radius_m, 0 to 1
    "radius_m",
    "heading_deg",  # clockwise from true north, as estimated
    "agl_m",  # metres above ground, as estimated
    "reason",  # short word for programs; null for a fix
    "detail",  # one sentence for people; null for a fix
    "evidence",  # names and numbers
    "latency_ms",
)
INTEGRITY_KEYS = (  # absent in earlier files
    "place_probability",  # that the place is right, 0 to 1; null: unknown
    "protection_level_m",  # the error exceeds it with a probability of risk; null: infinite
    "risk",
)
GROUND_KEYS = (
    "ground_lat_deg",  # what the middle of the picture shows
    "ground_lon_deg",
    "ground_cov_en_m2",  # rows as in cov_en_m2; null where unknown, absent in earlier files
)
POSE_KEYS = (
    "pitch_deg",  # as estimated; 0 looks straight down, positive ahead
    "roll_deg",  # 0 looks straight down, positive left
    "pose_cov",  # upper triangle (21) of 6 x 6, row by row: metres east, north, up, degrees of
)  # heading, pitch, roll; null where they were not estimated together
TRACK_KEYS = (
    "tracked",  # true: the position is estimated from all views so far
    "state",  # one of `STATES`
)
MOTION_KEYS = ("vel_east_mps", "vel_north_mps", "vel_std_mps", "recognized")
STD_KEYS = ("heading_std_deg", "log_scale_std")
"""In the evidence of a file, and fields of `Fix`, like those of `TelemetryBias`."""
NO_VELOCITY = (math.nan, math.nan)
STATES = ("searching", "tracking", "coasting", "lost")
MAX_LINE_BYTES = 2**20  # limit of a line; the evidence of a view takes about 1000 bytes
MAX_RESULTS = 1_000_000  # limit of lines: as many as a flight folder may have views


@dataclass(frozen=True)
class Identity:
    """SHA-256 (hex) of the map and of the flight of a run; None where unknown."""

    map_sha256: str | None = None
    flight_sha256: str | None = None

    def added_to(self, line: str) -> str:
        """A line of JSON with the digests that are known at its end."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        return line[:-1] + ", " + json.dumps(known)[1:] if known else line

    def differences(self, other: "Identity", map_path: Path | None, flight: Path | None) -> str:
        """What is known of both and differs: the map or the flight at these paths; else ""."""
        pairs = (
            ("map", map_path, self.map_sha256, other.map_sha256),
            ("flight", flight, self.flight_sha256, other.flight_sha256),
        )
        return " and ".join(
            f"another {kind} ({own[:8]}) than {path} ({its[:8]})"
            for kind, path, own, its in pairs
            if own and its and own != its
        )


@dataclass
class FlightDigest:
    """SHA-256 of names, times and reported headings of the views of a flight, in order.

    The digest of a recording and of the flight folder that it was imported to is the same unless
    views were left out or renamed.
    """

    _sum: Any = field(default_factory=hashlib.sha256)

    def watching(self, views: Iterable[RecordedView]) -> Iterator[RecordedView]:
        """The same views, which are counted as they pass."""
        for view in views:
            telemetry = view.telemetry
            text = f"{view.frame}\t{telemetry.time_ns}\t{telemetry.yaw_deg:.6f}\n"
            self._sum.update(text.encode("utf-8", "surrogateescape"))
            yield view

    @property
    def sha256(self) -> str:
        """The digest (hex) of the views that have passed."""
        return str(self._sum.hexdigest())


def flight_digest(views: Iterable[RecordedView]) -> str:
    """SHA-256 (hex) of a flight with these views."""
    digest = FlightDigest()
    for _ in digest.watching(views):
        pass
    return digest.sha256


def read_identity(path: Path) -> Identity:
    """What the first line of a file of fixes states; raises `MissingFileError`."""
    with require_file(path, "file of fixes").open("rb") as stream:
        for raw in iter(lambda: stream.readline(2**16), b""):
            try:
                plain = json.loads(raw)
            except (ValueError, RecursionError):
                return Identity()
            if isinstance(plain, dict) and "frame" in plain:
                stated = (plain.get(each.name) for each in fields(Identity))
                return Identity(*(each if isinstance(each, str) else None for each in stated))
    return Identity()


UNKNOWN = Identity()  # of a run whose map and flight are not stated


def result_to_json(result: ViewResult) -> str:
    """One line of `fixes.jsonl`, without the line end: strict JSON in ASCII, keys as in `KEYS`."""
    plain = to_plain(result).items()
    texts = {key: json.dumps(value, allow_nan=False) for key, value in plain}
    texts["time_s"] = _seconds(result.time_ns)
    return "{" + ", ".join(f'"{key}": {text}' for key, text in texts.items()) + "}"


def to_plain(record: Any, risk: float = DEFAULT_RISK) -> dict[str, Any]:
    """Plain values of a `ViewResult` by the keys of a line, in their order; those of a fix or of
    none, with protection levels of this risk, lack what belongs to the flight."""
    if isinstance(record, ViewResult):
        values = to_plain(record.outcome, record.risk)
        values |= {"frame": record.frame, "time_s": record.time_ns / 1e9}
        values["latency_ms"] = _or_none(record.latency_ms)
        if isinstance(record.outcome, Fix):
            values["confident"] = record.is_confident
        if record.state is not None:
            values |= zip(TRACK_KEYS, (True, record.state), strict=True)
    else:
        values = _outcome_values(record)
        numbers = {
            **record.evidence,
            **(evidence_of_fields(record) if isinstance(record, Fix) else {}),
        }
        values["evidence"] = {str(k): _or_none(v) for k, v in numbers.items()}
        if isinstance(record, Fix):
            stated = record.place_probability, record.protection_level_m(risk), risk
            values |= zip(INTEGRITY_KEYS, map(_or_none, stated), strict=True)
    keys = (*KEYS, *INTEGRITY_KEYS, *GROUND_KEYS, *POSE_KEYS, *TRACK_KEYS)
    return {key: values[key] for key in keys if key in values}


def result_from_json(line: str) -> ViewResult:
    """The result in one line of `fixes.jsonl`.

    Keys that are not in `KEYS` are ignored, and so are positions of a line without a fix.
    Raises `FlightError` where the line is not strict JSON, a key is missing or has a wrong type.
    """
    try:
        values = json.loads(line, parse_float=Decimal, parse_constant=_refuse_constant)
    except (ValueError, ArithmeticError, RecursionError) as error:  # of an exponent
        raise FlightError(f"not a JSON object, cut off or damaged? ({error})") from error
    if not isinstance(values, dict):
        raise FlightError(f"expected a JSON object, got {values!r:.40}")
    state, confident = values.get("state"), values.get("confident")
    try:
        _checked(values, "state", f"one of {STATES}", state is None or state in STATES)
        is_mark = confident is None or isinstance(confident, bool)
        _checked(values, "confident", "true or false", is_mark)
        return ViewResult(
            frame=_checked(values, "frame", "text", isinstance(values["frame"], str)),
            time_ns=_time_ns(values),
            outcome=_outcome(values),
            latency_ms=_number(values, "latency_ms"),
            state=state,
            accepted=confident,
            risk=_share(values, "risk") if values.get("risk") is not None else DEFAULT_RISK,
        )
    except KeyError as error:
        raise FlightError(f"key {error.args[0]} is missing") from error


def write_results(path: Path, results: Iterable[ViewResult], identity: Identity = UNKNOWN) -> None:
    """Write `results` to `path`, one line each, whole or not at all; `-` is stdout.

    The first line states `identity`, the map and the flight that they were computed from.
    """
    stated = chain([identity], repeat(UNKNOWN))
    lines = map(result_to_json, results)
    write_lines(path, (own.added_to(line) + "\n" for line, own in zip(lines, stated, strict=False)))


def is_health(line: str) -> bool:
    """Whether a line of `fly --jsonl` is one of health, which is no result."""
    return line.startswith('{"health"')


def read_results(path: StrPath) -> list[ViewResult]:
    """All results in `path`, in its order; empty lines and those of health are skipped.

    Raises `MissingFileError` where there is no such file, and `FlightError` with the number of the
    first invalid line.
    """
    path = require_file(path, "file of fixes")
    results = []
    with path.open("rb") as stream:
        lines = iter(lambda: stream.readline(MAX_LINE_BYTES + 1), b"")
        for number, raw in enumerate(lines, start=1):
            try:
                if len(raw) > MAX_LINE_BYTES or number > MAX_RESULTS:
                    raise FlightError(
                        f"more than {MAX_LINE_BYTES:,} bytes in a line, or {MAX_RESULTS:,} lines"
                    )
                line = raw.decode("utf-8").strip()
                if line and not is_health(line):
                    results.append(result_from_json(line))
            except UnicodeDecodeError as error:
                raise FlightError(f"line {number}: not UTF-8 text: {path}") from error
            except FlightError as error:
                raise FlightError(f"line {number}: {error}: {path}") from error
    return results


def to_dataframe(fixes: StrPath | Iterable[Fix | NoFix | ViewResult]) -> Any:
    """A pandas table with one row for each of these, or for each line of a file of fixes.

    Columns are the keys of `fixes.jsonl`, numbers of the evidence as `evidence.NAME`. Raises
    `MissingExtraError` without pandas, and as `read_results`."""
    try:
        pandas: Any = import_module("pandas")
    except ImportError as error:
        raise MissingExtraError("a table of fixes needs pandas: pip install pandas") from error
    return pandas.json_normalize([each.to_dict() for each in _all(fixes)])


def to_geojson(fixes: StrPath | Iterable[Fix | NoFix | ViewResult]) -> dict[str, Any]:
    """A FeatureCollection (RFC 7946) with a point for each fix among these, or in a file of fixes;
    `json.dumps` makes text of it, GeoPandas' `from_features` a table. Raises as `read_results`."""
    pairs = [(getattr(x, "frame", None), getattr(x, "outcome", x)) for x in _all(fixes)]
    shown = [feature(frame, fix, fix.std_m) for frame, fix in pairs if isinstance(fix, Fix)]
    return {"type": "FeatureCollection", "features": shown}


def feature(
    frame: str | None, fix: Fix, std_m: float, height_m: float = math.nan
) -> dict[str, Any]:
    """Of GeoJSON; `height_m`: above mean sea level, NaN: unknown."""
    about = {"agl_m": fix.agl_m, "heading_deg": fix.heading_deg, "std_m": std_m}
    about["confidence"] = fix.confidence
    known = {name: None if math.isnan(x) else round(x, 4) for name, x in about.items()}
    place = fix.lon_deg, fix.lat_deg, height_m
    point = [round(value, 8) for value in place if math.isfinite(value)]
    geometry = {"type": "Point", "coordinates": point}
    return {"type": "Feature", "geometry": geometry, "properties": {"frame": frame, **known}}


def _all(fixes: StrPath | Iterable[Any]) -> Iterable[Any]:
    found = read_results(fixes) if isinstance(fixes, str | os.PathLike) else fixes
    for each in (found := list(found) if isinstance(found, Iterable) else [found]):
        if not isinstance(each, Fix | NoFix | ViewResult):
            kind = "a path, or Fix, NoFix or ViewResult records"
            raise ArgumentError(f"fixes must be {kind}, got {type(each).__name__}")
    return found


def _outcome_values(outcome: Fix | NoFix) -> dict[str, Any]:
    if isinstance(outcome, NoFix):
        no_fix = {"status": "no_fix", "reason": outcome.reason, "detail": outcome.detail}
        return {**dict.fromkeys(KEYS[3:11]), **no_fix}
    values = {
        "status": "fix",
        "confident": outcome.is_confident,
        "reason": None,
        "detail": None,
        **{key: _or_none(getattr(outcome, key)) for key in (*KEYS[4:6], *KEYS[7:11])},
        "cov_en_m2": _rows(outcome.cov_en_m2),
    }
    if outcome.ground_latlon_deg is not None:
        lat, lon = map(_or_none, outcome.ground_latlon_deg)
        cov = outcome.ground_cov_en_m2
        values |= zip(GROUND_KEYS, (lat, lon, None if cov is None else _rows(cov)), strict=True)
    angles, pose_cov = (outcome.pitch_deg, outcome.roll_deg), outcome.pose_cov
    if pose_cov is not None or any(map(math.isfinite, angles)):
        upper = None
        if pose_cov is not None and np.isfinite(pose_cov).all():
            upper = pose_cov[np.triu_indices(6)].tolist()
        values |= zip(POSE_KEYS, (*map(_or_none, angles), upper), strict=True)
    return values


def evidence_of_fields(fix: Fix) -> dict[str, float]:
    """Fields of a fix that `fixes.jsonl` has in its evidence, as far as they are known: velocity of
    a track, whether the view shows the map, biases and standard deviations."""
    velocity = fix.known_velocity_en_mps
    east_mps, north_mps = NO_VELOCITY if velocity is None else map(float, velocity)
    values = east_mps, north_mps, fix.vel_std_mps, fix.recognized
    stated = dict(zip(MOTION_KEYS, values, strict=True)) | fix.bias._asdict()
    stated |= {key: getattr(fix, key) for key in STD_KEYS}
    return {key: value for key, value in stated.items() if math.isfinite(value)}


def _rows(cov: NDArray[np.float64]) -> list[list[float | None]]:
    return [[_or_none(value) for value in row] for row in cov]


def _outcome(values: Mapping[str, Any]) -> Fix | NoFix:
    status, evidence = values["status"], values["evidence"]
    _checked(values, "evidence", "an object", isinstance(evidence, dict))
    evidence = {key: _number(evidence, key, f"evidence {key!r:.40}") for key in evidence}
    if status == "no_fix":
        reason = _checked(values, "reason", "text", isinstance(values["reason"], str))
        return NoFix(reason=reason, detail=str(values.get("detail") or ""), evidence=evidence)
    _checked(values, "status", "'fix' or 'no_fix'", status == "fix")
    *velocity, vel_std_mps, recognized = (evidence.pop(key, math.nan) for key in MOTION_KEYS)
    bias = TelemetryBias(*(evidence.pop(key, math.nan) for key in TelemetryBias._fields))
    stds = {key: evidence.pop(key, math.nan) for key in STD_KEYS}
    if vel_std_mps < 0 or not (math.isnan(recognized) or 0 <= recognized <= 1):
        raise FlightError(
            "evidence: expected vel_std_mps of 0 or more and recognized of 0 to 1, got "
            f"{vel_std_mps:g} and {recognized:g}"
        )
    ground = None
    if GROUND_KEYS[0] in values:
        ground = _angle(values, GROUND_KEYS[0], 90.0), _angle(values, GROUND_KEYS[1], 180.0)
    # Absent in earlier files.
    values = {**dict.fromkeys((*INTEGRITY_KEYS, *GROUND_KEYS, *POSE_KEYS)), **values}
    cov_en_m2 = _numbers(values, "cov_en_m2", (2, 2))
    return Fix(
        lat_deg=_angle(values, "lat_deg", 90.0),
        lon_deg=_angle(values, "lon_deg", 180.0),
        cov_en_m2=np.full((2, 2), math.nan) if cov_en_m2 is None else cov_en_m2,
        confidence=_share(values, "confidence"),
        **{name: _number(values, name) for name in ("radius_m", "heading_deg", "agl_m")},
        evidence=evidence,
        ground_latlon_deg=ground,
        ground_cov_en_m2=_numbers(values, GROUND_KEYS[2], (2, 2)),
        **{name: _number(values, name) for name in POSE_KEYS[:2]},
        pose_cov=_pose_covariance(values),
        place_probability=_share(values, INTEGRITY_KEYS[0]),
        vel_en_mps=None if math.isnan(sum(velocity)) else (velocity[0], velocity[1]),
        vel_std_mps=vel_std_mps,
        recognized=recognized,
        bias=bias,
        **stds,
    )


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(int(time_ns)), 1_000_000_000)
    decimals = f"{rest:09d}".rstrip("0") or "0"
    return f"{'-' if time_ns < 0 else ''}{whole}.{decimals}"


def _time_ns(values: Mapping[str, Any]) -> int:
    seconds = _number(values, "time_s")
    _checked(values, "time_s", "seconds that fit 64 bits of ns", abs(seconds) < 2**63 / 1e9)
    return int(Decimal(values["time_s"]).scaleb(9).to_integral_value())


def _or_none(value: float) -> float | None:
    value = float(value)
    return value if math.isfinite(value) else None


def _checked(values: Mapping[str, Any], key: str, expected: str, sound: bool) -> Any:
    if not sound:
        raise FlightError(f"{key}: expected {expected}, got {values[key]!r:.40}")
    return values.get(key)


def _number(values: Mapping[str, Any], key: str, name: str = "") -> float:
    """A finite number, NaN for null; `name`: of the value, for its error."""
    value = values[key]
    if value is None:
        return math.nan
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise FlightError(f"{name or key}: expected a finite number or null, got {value!r:.40}")
    return number


def _share(values: Mapping[str, Any], key: str) -> float:
    share = _number(values, key)
    _checked(values, key, "0 to 1", math.isnan(share) or 0.0 <= share <= 1.0)
    return share


def _angle(values: Mapping[str, Any], key: str, limit_deg: float) -> float:
    angle = _number(values, key)  # not NaN: a fix has a position
    _checked(values, key, f"-{limit_deg:g} to {limit_deg:g}", abs(angle) <= limit_deg)
    return angle


def _numbers(
    values: Mapping[str, Any], key: str, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """The numbers of a list, or of a list of lists, of this shape, NaN for null; None for null in
    place of all."""
    if values[key] is None:
        return None
    found = np.array(values[key], dtype=object)
    _checked(values, key, f"numbers in lists of {shape}", found.shape == shape)
    numbers = np.array([_number({key: each}, key) for each in found.flat]).reshape(shape)
    numbers.setflags(write=False)
    return numbers


def _pose_covariance(values: Mapping[str, Any]) -> NDArray[np.float64] | None:
    upper = _numbers(values, POSE_KEYS[2], (21,))
    if upper is None:
        return None
    _checked(values, POSE_KEYS[2], "21 numbers", not np.isnan(upper).any())
    cov = np.zeros((6, 6))
    cov[np.triu_indices(6)] = upper
    cov += np.triu(cov, 1).T
    cov.setflags(write=False)
    return cov


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON; write null")
