"""`fixes.jsonl`: what is written can be read, by anyone, and what is broken is named."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthonav.core.errors import FlightError
from orthonav.core.flight.fixes import (
    GROUND_KEYS,
    INTEGRITY_KEYS,
    KEYS,
    POSE_KEYS,
    read_results,
    result_from_json,
    result_to_json,
)
from orthonav.core.records import Fix, NoFix, ViewResult

FIX_LINE = {
    "frame": "a.jpg",
    "time_s": 12.5,
    "status": "fix",
    "lat_deg": 48.1,
    "lon_deg": -4.3,
    "cov_en_m2": [[4.0, 1.0], [1.0, 9.0]],
    "confidence": 0.93,
    "radius_m": 15.0,
    "heading_deg": 90.0,
    "agl_m": 120.0,
    "reason": None,
    "detail": None,
    "evidence": {"peak_ratio": 1.8},
    "latency_ms": 41.5,
}
NO_FIX_LINE = {
    "frame": "b.jpg",
    "time_s": 13.0,
    "status": "no_fix",
    "reason": "blank",
    "evidence": {},
    "latency_ms": 3,
}

numbers = st.floats(allow_nan=True, allow_infinity=False)
evidences = st.dictionaries(st.text(max_size=8), numbers, max_size=4)
covariances = st.lists(numbers, min_size=4, max_size=4).map(lambda v: np.reshape(v, (2, 2)))
pose_covariances = st.lists(numbers.filter(math.isfinite), min_size=36, max_size=36).map(
    lambda v: np.triu(np.reshape(v, (6, 6))) + np.triu(np.reshape(v, (6, 6)), 1).T
)
grounds = st.tuples(st.floats(-90, 90), st.floats(-180, 180))
fixes = st.builds(
    Fix,
    lat_deg=st.floats(-90, 90),
    lon_deg=st.floats(-180, 180),
    cov_en_m2=covariances,
    confidence=st.floats(0, 1) | st.just(math.nan),
    radius_m=numbers,
    heading_deg=numbers,
    agl_m=numbers,
    evidence=evidences,
    ground_latlon_deg=grounds | st.none(),
    pitch_deg=numbers,
    roll_deg=numbers,
    pose_cov=pose_covariances | st.none(),
    place_probability=st.floats(0, 1) | st.just(math.nan),
)
fixes |= st.builds(replace, fixes, ground_latlon_deg=grounds, ground_cov_en_m2=covariances)
no_fixes = st.builds(NoFix, reason=st.text(), detail=st.text(), evidence=evidences)
view_results = st.builds(
    ViewResult,
    frame=st.text(alphabet=st.characters()),
    time_ns=st.integers(-(2**62), 2**62),
    outcome=fixes | no_fixes,
    latency_ms=numbers,
    risk=st.floats(1e-6, 0.5),
)


def fields(result: ViewResult) -> dict:
    """All values of a result in a form that compares, NaN included."""
    outcome = {name: getattr(result.outcome, name) for name in vars(result.outcome)}
    outcome["evidence"] = dict(outcome["evidence"])
    values = [type(result.outcome).__name__, result.frame, result.time_ns, result.latency_ms]
    if isinstance(result.outcome, Fix):
        values.append(result.risk)
    for key in ("cov_en_m2", "ground_cov_en_m2", "pose_cov"):
        if outcome.get(key) is not None:
            outcome[key] = outcome[key].tolist()
    return repr([*values, sorted(outcome.items())])


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not strict JSON")


@settings(max_examples=25)
@given(view_results)
def test_a_result_survives_the_round_trip(result: ViewResult) -> None:
    assert fields(result_from_json(result_to_json(result))) == fields(result)


@given(view_results)
def test_a_line_is_strict_json_with_the_keys_in_order(result: ViewResult) -> None:
    line = result_to_json(result)
    values = json.loads(line, parse_constant=refuse)
    more = [keys for keys in (INTEGRITY_KEYS, GROUND_KEYS, POSE_KEYS) if keys[0] in values]
    assert tuple(values) == sum(more, start=KEYS)
    assert "\n" not in line and line.isascii()
    assert values["time_s"] == result.time_ns / 10**9  # rounded once


def test_nanoseconds_since_1970_are_exact() -> None:
    time_ns = 1_767_225_600_123_456_789
    line = result_to_json(ViewResult("a", time_ns, NoFix("blank", ""), 1.0))
    assert '"time_s": 1767225600.123456789,' in line
    assert result_from_json(line).time_ns == time_ns


def test_a_line_without_a_ground_or_an_attitude_is_read() -> None:
    """As lines of earlier versions, of tiles and of tracks are."""
    fix = result_from_json(json.dumps(FIX_LINE)).outcome
    assert isinstance(fix, Fix) and math.isnan(fix.pitch_deg) and math.isnan(fix.roll_deg)
    assert fix.ground_latlon_deg is fix.ground_cov_en_m2 is fix.pose_cov is None
    plain = json.loads(result_to_json(ViewResult("a", 0, fix, 1.0)))
    assert tuple(plain) == KEYS + INTEGRITY_KEYS
    assert plain["place_probability"] is plain["protection_level_m"] is None  # 0.93 is too little
    ground = {"ground_lat_deg": 48.0, "ground_lon_deg": -4.0}
    fix = result_from_json(json.dumps({**FIX_LINE, **ground})).outcome
    assert isinstance(fix, Fix) and fix.ground_latlon_deg == (48.0, -4.0)
    assert fix.ground_cov_en_m2 is None


def test_a_line_states_the_protection_level_and_its_risk() -> None:
    fix = result_from_json(json.dumps({**FIX_LINE, "place_probability": 0.9999})).outcome
    assert isinstance(fix, Fix) and fix.place_probability == 0.9999
    levels = {}
    for risk in (1e-3, 1e-2):
        line = result_to_json(ViewResult("a", 0, fix, 1.0, risk=risk))
        plain = json.loads(line)
        assert plain["protection_level_m"] == fix.protection_level_m(risk) and plain["risk"] == risk
        assert result_from_json(line).risk == risk
        levels[risk] = plain["protection_level_m"]
    assert levels[1e-3] > levels[1e-2] > 3
    for wrong in ({"place_probability": 1.1}, {"risk": 2}, {"risk": "low"}):
        with pytest.raises(FlightError, match=next(iter(wrong))):
            result_from_json(json.dumps({**FIX_LINE, **wrong}))


def test_the_camera_of_a_line_can_be_read_by_anyone() -> None:
    cov = np.arange(36.0).reshape(6, 6)
    cov = cov + cov.T
    fix = Fix(1.0, 2.0, np.eye(2), 0.9, 15.0, 3.0, 100.0, pitch_deg=-2.5, roll_deg=1.0)
    plain = json.loads(result_to_json(ViewResult("a", 0, fix, 1.0)))
    assert plain["pitch_deg"] == -2.5 and plain["pose_cov"] is None
    values = json.loads(result_to_json(ViewResult("a", 0, replace(fix, pose_cov=cov), 1.0)))
    numbers = iter(values["pose_cov"])
    for row in range(6):
        for col in range(row, 6):
            assert next(numbers) == cov[row, col]
    assert next(numbers, None) is None
    read = result_from_json(json.dumps(values)).outcome
    assert isinstance(read, Fix) and read.pose_cov is not None
    assert (read.pose_cov == cov).all() and not read.pose_cov.flags.writeable
    unknown = replace(fix, pose_cov=np.full((6, 6), math.inf))
    assert json.loads(result_to_json(ViewResult("a", 0, unknown, 1.0)))["pose_cov"] is None


def test_extra_keys_and_positions_without_a_fix_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "fixes.jsonl"
    tracked = {**FIX_LINE, "tracked": True, "state": "tracking"}
    lost = {**NO_FIX_LINE, "lat_deg": 48.0, "lon_deg": "?", "state": "lost"}
    path.write_text(f"{json.dumps(tracked)}\r\n\n{json.dumps(lost)}")
    fix, no_fix = (result.outcome for result in read_results(path))
    assert fix.lat_deg == 48.1 and fix.cov_en_m2.tolist() == [[4, 1], [1, 9]]
    assert no_fix.reason == "blank" and no_fix.detail == ""


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *((key, None) for key in ("time_s", "lat_deg", "evidence")),
        *(("frame", 7), ("time_s", "12"), ("time_s", 1e12), ("status", "maybe"), ("state", "")),
        *(("lat_deg", 90.5), ("lat_deg", True), ("lon_deg", -181), ("confidence", 1.01)),
        *(("cov_en_m2", bad) for bad in ([1, 2, 3, 4], [[1, 2], [3]], [[1, 2], [3, "4"]])),
        *(("ground_lat_deg", 91), ("ground_cov_en_m2", [[1, 2]]), ("pitch_deg", "2")),
        *(("pose_cov", bad) for bad in ([1.0] * 20, 1.0, [1.0] * 20 + [None], [1.0] * 20 + ["1"])),
        *(("radius_m", []), ("evidence", {"a": "b"}), ("latency_ms", 10**400)),
    ],
)
def test_a_wrong_or_missing_value_is_named(key: str, value: object) -> None:
    with pytest.raises(FlightError, match=rf"^{key}( 'a')?: expected "):
        result_from_json(json.dumps({**FIX_LINE, key: value}))
    if key in FIX_LINE:
        line = {name: value for name, value in FIX_LINE.items() if name != key}
        with pytest.raises(FlightError, match=f"^key {key} is missing"):
            result_from_json(json.dumps(line))


@pytest.mark.parametrize(
    "bad",
    [
        b'{"frame": "a.jpg", "time_s": 1',
        b"[]",
        b"null",
        b"\xff\xfe{}",
        b"[" * 100_000,
        json.dumps({**FIX_LINE, "agl_m": math.nan}).encode(),
        json.dumps(FIX_LINE).replace("120.0", "1e999").encode(),
        json.dumps(FIX_LINE).replace("120.0", "1" * 5000).encode(),
        json.dumps(FIX_LINE).replace("12.5", "1e999999999").encode(),
        json.dumps(FIX_LINE).replace("12.5", "1e" + "9" * 400).encode(),
    ],
)
def test_a_broken_line_is_named_by_its_number(tmp_path: Path, bad: bytes) -> None:
    path = tmp_path / "fixes.jsonl"
    path.write_bytes(json.dumps(FIX_LINE).encode() + b"\n" + bad + b"\n")
    with pytest.raises(FlightError, match=r"^line 2: .*fixes\.jsonl$"):
        read_results(path)


def test_a_guess_is_marked() -> None:
    """By the criterion of the run, else by its confidence, as in files without the mark."""
    fix = result_from_json(json.dumps({**FIX_LINE, "confidence": 0.7}))
    assert not fix.is_confident and result_from_json(json.dumps(FIX_LINE)).is_confident
    lower = replace(fix, accepted=True)
    assert json.loads(result_to_json(fix))["confident"] is False
    assert json.loads(result_to_json(lower))["confident"] is True
    assert result_from_json(result_to_json(lower)).is_confident
    assert not result_from_json(json.dumps({**NO_FIX_LINE, "confident": True})).is_confident
    with pytest.raises(FlightError, match="confident: expected true or false"):
        result_from_json(json.dumps({**FIX_LINE, "confident": "yes"}))


def test_velocity_and_recognition_of_a_track_stand_in_its_evidence() -> None:
    motion = {"vel_east_mps": 3.0, "vel_north_mps": -4.0, "vel_std_mps": 0.5, "recognized": 0.9}
    plain = {**FIX_LINE, "evidence": {"peak_ratio": 1.8, **motion}}
    read = result_from_json(json.dumps(plain))
    assert isinstance(fix := read.outcome, Fix) and dict(fix.evidence) == FIX_LINE["evidence"]
    assert (fix.vel_en_mps, fix.vel_std_mps, fix.recognized) == ((3.0, -4.0), 0.5, 0.9)
    assert json.loads(result_to_json(read))["evidence"] == plain["evidence"]


@pytest.mark.parametrize("wrong", [{"recognized": 7.0}, {"vel_std_mps": -3.0}])
def test_impossible_motion_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(FlightError, match="recognized of 0 to 1"):
        result_from_json(json.dumps({**FIX_LINE, "evidence": wrong}))
