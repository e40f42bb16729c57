"""Figures of a track against cases worked out by hand and drawn by chance; what is shown of it."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from helpers import textured
from orthonav.cli import main
from orthonav.core.errors import FlightError
from orthonav.core.flight.fixes import write_results
from orthonav.core.flight.folder import FlightWriter
from orthonav.core.geo.camera import Camera, camera_from_en
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.records import Fix, NoFix, Telemetry, ViewResult
from orthonav.ground.evaluate.calibration import nees_mean_bounds
from orthonav.ground.evaluate.contact_sheet import (
    Row,
    row_text,
    sheet_picture,
    worst_first,
    worst_rows,
)
from orthonav.ground.evaluate.figures import seconds_since_first
from orthonav.ground.evaluate.metrics import Comparison, compare, measure
from orthonav.ground.evaluate.plots import (
    STATE_STYLES,
    error_picture,
    track_map_picture,
)
from orthonav.ground.evaluate.report import write_report
from orthonav.ground.evaluate.tables import (
    FlightReport,
    flights_to_json,
    metrics_to_json,
    summary,
    total,
    track_rows,
)
from orthonav.ground.evaluate.track import (
    TrackMetrics,
    check_consistency,
    course_en,
    effective_number,
    measure_track,
)
from orthonav.ground.report.drawing import Drawing

CENTRE = LocalFrame(48.0, -4.5)
COV = np.array([[25.0, 12.0], [12.0, 16.0]])
GOLDEN = Path(__file__).parents[1] / "data" / "golden_v1.onav"
LEARNT = {"heading_bias_deg": 3.0, "log_scale_bias": 0.02}


def flown(
    errors_en_m,
    states,
    *,
    cov_en_m2=COV,
    confidence=0.95,
    displacement_en_m=None,
    times_ns=None,
    unknown=(),
    local=CENTRE,
    own_radius_m=35.0,
) -> tuple[Comparison, list[ViewResult]]:
    """Views 10 m and 1 s apart to the east, off by `errors_en_m`, None for no fix; `unknown` have
    no truth."""
    n = len(errors_en_m)
    states = [states] * n if isinstance(states, str | None) else states
    if displacement_en_m is None:
        displacement_en_m = np.stack([10.0 * np.arange(n), np.zeros(n)], axis=1)
    times_ns = [10**9 * i for i in range(n)] if times_ns is None else times_ns
    confident, radii_m = np.broadcast_to(confidence, n), np.broadcast_to(own_radius_m, n)
    truth, results = {}, []
    for i, (error, at) in enumerate(zip(errors_en_m, displacement_en_m, strict=True)):
        lat, lon = local.latlon_from_en(np.array(at, dtype=float))
        if i not in unknown:
            truth[f"{i:04d}.jpg"] = (float(lat), float(lon))
        outcome: Fix | NoFix = NoFix("searching", "")
        if error is not None:
            fix_lat, fix_lon = local.latlon_from_en(np.add(at, error))
            where = float(fix_lat), float(fix_lon), cov_en_m2
            outcome = Fix(*where, float(confident[i]), float(radii_m[i]), 90.0, 100.0, LEARNT)
        results.append(ViewResult(f"{i:04d}.jpg", times_ns[i], outcome, 10.0, states[i]))
    return compare(truth, results, local), results


def tracked(*arguments, radius_m=15.0, **named) -> TrackMetrics:
    found = measure_track(*flown(*arguments, **named), radius_m)
    assert found is not None
    return found


def drawn(n=200, seed=0, alike=0.0):
    """(n, 2) errors of covariance `COV`, each `alike` times the one before."""
    random = np.random.default_rng(seed)
    white = random.normal(size=(n, 2))
    for i in range(1, n):
        white[i] = alike * white[i - 1] + math.sqrt(1 - alike**2) * white[i]
    return white @ np.linalg.cholesky(COV).T


# Consistency.


def test_errors_of_their_own_covariance_are_consistent_and_of_a_quarter_over_confident() -> None:
    errors = drawn()
    verdicts = {
        scale: tracked(errors, "tracking", cov_en_m2=scale * COV).consistency.verdict
        for scale in (0.25, 1.0, 4.0)
    }
    assert verdicts == {0.25: "over-confident", 1.0: "consistent", 4.0: "under-confident"}


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_of_twenty_consistent_tracks_about_one_is_called_otherwise(alike: float) -> None:
    found = [
        check_consistency(drawn(300, seed, alike), np.tile(COV, (300, 1, 1))) for seed in range(60)
    ]
    assert sum(each.verdict == "consistent" for each in found) >= 53
    independent = sum(
        each.independent_low <= each.nees_mean <= each.independent_high for each in found
    )
    assert (independent >= 53) == (alike == 0.0)  # neighbours that are alike deceive these bounds
    mean = np.mean([each.nees_mean for each in found])
    assert mean == pytest.approx(2.0, abs=0.15)
    small = check_consistency(drawn(300, 1, alike), np.tile(COV / 4, (300, 1, 1)))
    assert small.verdict == "over-confident"


def test_bounds_are_those_of_chi_square() -> None:
    for n in (1.0, 7.5, 300.0):
        expected = chi2.ppf([0.025, 0.975], 2 * n) / n
        assert nees_mean_bounds(n) == pytest.approx(tuple(expected))
    assert all(map(math.isnan, nees_mean_bounds(0.0)))


def test_effective_number_of_views() -> None:
    assert effective_number(np.ones((50, 2))) == pytest.approx(1.0)
    assert effective_number(np.zeros((50, 2))) == pytest.approx(1.0)
    assert [effective_number(np.ones((n, 2))) for n in (0, 1)] == [0.0, 1.0]
    root = np.linalg.inv(np.linalg.cholesky(COV)).T
    white = np.mean([effective_number(drawn(500, s) @ root) for s in range(10)])
    assert white == pytest.approx(500, rel=0.05)
    # squares of an AR(1) have autocorrelation 0.81^k: tau is (1 + 0.81) / (1 - 0.81)
    alike = np.mean([effective_number(drawn(4000, s, 0.9) @ root) for s in range(10)])
    assert alike == pytest.approx(4000 * 0.19 / 1.81, rel=0.15)


# States, first fix, false locks.


STATES = ["searching"] * 2 + ["tracking"] * 3 + ["lost"] * 2 + ["tracking"] * 2 + ["lost"]
SURE = [0.1, 0.99, 0.95, 0.95, 0.5, 0.2, 0.2, 0.95, 0.95, 0.1]
ERRORS = [None, (90.0, 0), (3.0, 0), (4, 0), (40, 0), (50, 0), (5, 0), (0, 70), (0, 61), (99, 0)]
TIMES_S = [0, 1, 3, 4, 5, 6, 16, 17, 18, 20]


def by_hand(**named) -> TrackMetrics:
    times_ns = [1_700_000_000 * 10**9 + s * 10**9 for s in TIMES_S]
    return tracked(ERRORS, STATES, confidence=SURE, times_ns=times_ns, **named)


def test_first_confirmed_fix_and_errors_from_then_on() -> None:
    track = by_hand()
    assert (track.first_view, track.first_s) == (3, 3.0)
    assert (track.after.n_views, track.after.n_fixes) == (8, 8)
    assert track.after.error_median_m == pytest.approx(45.0, abs=0.01)
    assert track.after.error_max_m == pytest.approx(99.0, abs=0.01)
    assert dict(track.after.acc_at_m) == {15.0: 3 / 8, 25.0: 3 / 8, 60.0: 5 / 8}


def test_states_by_view_and_by_the_time_until_the_next() -> None:
    track = by_hand()
    assert dict(track.share_of_views) == pytest.approx(
        {"searching": 0.2, "tracking": 0.5, "coasting": 0.0, "lost": 0.3}
    )
    assert dict(track.share_of_time) == pytest.approx(
        {"searching": 3 / 20, "tracking": 6 / 20, "coasting": 0.0, "lost": 11 / 20}
    )
    assert track.n_lost == 2


def test_longest_without_a_confident_fix() -> None:
    track = by_hand()
    # views 4 to 6: tracking with low confidence, then lost, until view 7
    assert (track.low_confidence.seconds_s, track.low_confidence.path_m) == (
        12.0,
        pytest.approx(30.0, abs=0.01),
    )
    assert track.low_confidence_after == track.low_confidence
    start = tracked([None] * 5 + [(1.0, 0.0)] * 2, ["searching"] * 5 + ["tracking"] * 2)
    assert start.low_confidence.path_m == pytest.approx(50.0, abs=0.01)
    assert (start.low_confidence_after.seconds_s, start.low_confidence_after.path_m) == (0.0, 0.0)


def test_false_locks_are_stretches_that_are_confident_or_tracking_and_wrong() -> None:
    track = by_hand()
    # view 1 confident; view 4 tracking; views 7 and 8 both; view 5 and 9 are neither
    assert (track.far_m, track.n_confident_wrong, track.n_false_locks) == (35.0, 4, 3)
    assert track.false_lock_longest_s == 3.0  # 17 s to 20 s
    wide = by_hand(radius_m=65.0)
    assert (wide.far_m, wide.n_confident_wrong, wide.n_false_locks) == (65.0, 2, 2)


# Along and across.


def test_ahead_and_right_are_positive_whatever_the_course() -> None:
    angle = np.linspace(0.0, 1.5 * math.pi, 60)
    course = np.stack([np.sin(angle), np.cos(angle)], axis=1)  # from north, clockwise
    way = 300.0 * np.stack([1 - np.cos(angle), np.sin(angle)], axis=1)
    right = np.stack([course[:, 1], -course[:, 0]], axis=1)
    track = tracked(4.0 * course - 2.0 * right, "tracking", displacement_en_m=way)
    inner = slice(1, -1)  # one-sided at the ends
    np.testing.assert_allclose(track.series.along_m[inner], 4.0, atol=0.02)
    np.testing.assert_allclose(track.series.across_m[inner], -2.0, atol=0.02)
    assert track.along.mean_m == pytest.approx(4.0, abs=0.02)
    assert track.across.rmse_m == pytest.approx(2.0, abs=0.02)
    assert track.across.std_m < 0.1


def test_standing_still_has_no_course_and_dense_views_have_one() -> None:
    east = np.concatenate([np.arange(10) * 10.0, np.full(6, 90.0)])
    course = course_en(np.stack([east, np.zeros(16)], axis=1))
    assert np.isnan(course[10:]).all()
    np.testing.assert_allclose(course[:10], [[1.0, 0.0]] * 10)
    track = tracked(
        [(3.0, 1.0)] * 16, "tracking", displacement_en_m=np.stack([east, 0 * east], axis=1)
    )
    assert track.along.n_views == 10
    random = np.random.default_rng(0)
    dense = np.stack([np.arange(400) * 0.2, random.normal(0.0, 0.1, 400)], axis=1)
    course = course_en(dense)
    assert np.isfinite(course).all() and course[20:-20, 0].min() > 0.98


# What may be wrong with the input.


@pytest.mark.parametrize(
    ("errors", "states", "named"),
    [
        ([(1.0, 0.0)], "tracking", {}),
        ([None], "searching", {}),
        ([None] * 5, "lost", {}),
        ([None] * 5, "tracking", {}),
        ([(1.0, 0.0)] * 5, "tracking", {"times_ns": [math.nan, 1, 2, 3, 4]}),
        ([(1.0, 0.0)] * 5, "tracking", {"times_ns": [0, 1, math.nan, 3, 4]}),
        ([(1.0, 0.0)] * 5, "tracking", {"times_ns": [5, 4, 3, 2, 1]}),
        ([(1.0, 0.0)] * 5, "lost", {"times_ns": [7] * 5}),
        ([(1.0, 0.0)] * 5, "tracking", {"displacement_en_m": np.zeros((5, 2))}),
        ([(1.0, 0.0)] * 5, ["tracking", None, "lost", None, "searching"], {"unknown": (0, 1, 3)}),
        ([(1.0, 0.0)] * 5, "tracking", {"confidence": math.nan, "unknown": (0, 4)}),
        ([(1.0, 0.0)] * 5, "tracking", {"cov_en_m2": np.full((2, 2), math.nan)}),
        ([(1.0, 0.0)] * 5, "tracking", {"cov_en_m2": np.eye(2) * 1e-200}),
    ],
)
def test_odd_tracks_are_measured(errors, states, named) -> None:
    comparison, results = flown(errors, states, **named)
    track = measure_track(comparison, results, 15.0)
    assert track is not None
    flight = FlightReport("odd", comparison, measure(comparison), track=track)
    json.dumps(flights_to_json([flight], flight.metrics), allow_nan=False)
    for text in (summary([flight], flight.metrics), "".join(said for _, said in track_rows(track))):
        assert "nan" not in text.lower() and "inf" not in text.lower()


@pytest.mark.parametrize("times", [[math.nan, 1.0], [1.0, math.nan], [2, 1], [3, 3], []])
def test_times_that_do_not_rise_are_undefined(times: list) -> None:
    assert np.isnan(seconds_since_first(times)).all()


def test_states_count_without_a_truth_and_errors_only_with_one() -> None:
    errors = [None, (500.0, 0.0), (3.0, 0.0), (3.0, 0.0), (70.0, 0.0)]
    states = ["searching", "searching", "tracking", "tracking", "tracking"]
    track = tracked(errors, states, unknown=(0, 1, 4), confidence=0.5)
    assert (track.n_views, track.n_compared, track.first_view) == (5, 2, 3)
    assert track.share_of_views["searching"] == 0.4
    assert track.after.n_views == 2 and track.n_false_locks == 0


def test_results_of_another_flight_and_duplicate_frames_are_refused() -> None:
    comparison, results = flown([(1.0, 0.0)] * 3, "tracking")
    with pytest.raises(ValueError, match="not among the results"):
        measure_track(comparison, results[1:], 15.0)
    with pytest.raises(FlightError, match="more than one result"):
        compare({"0000.jpg": (48.0, -4.5)}, [results[0], results[0]])


# What is shown.


def test_views_placed_one_by_one_have_no_track(tmp_path: Path, no_plots) -> None:
    comparison, results = flown([(1.0, 0.0)] * 4, None)
    assert measure_track(comparison, results, 15.0) is None
    flight = FlightReport("f", comparison, measure(comparison))
    assert flights_to_json([flight], flight.metrics) == metrics_to_json(flight.metrics)
    assert "track" not in summary([flight], flight.metrics)
    html = write_report(tmp_path, [flight]).read_text("utf-8")
    assert "Track" not in html and html.count("<figure") == 6


def test_several_flights_are_summed_up() -> None:
    flights = []
    for name, errors, states in (
        ("short", [(50.0, 0.0)] * 2, "tracking"),
        ("long", [(2.0, 0.0)] * 6, ["searching", *["tracking"] * 5]),
        ("single", [(2.0, 0.0)] * 4, None),
        ("never", [None] * 2, "searching"),
    ):
        comparison, results = flown(errors, states)
        track = measure_track(comparison, results, 15.0)
        flights.append(FlightReport(name, comparison, measure(comparison), track=track))
    plain = json.loads(json.dumps(flights_to_json(flights, total(flights)), allow_nan=False))
    whole = plain["track"]
    assert (whole["n_tracks"], whole["n_found"], whole["n_views"]) == (3, 2, 10)
    assert whole["after"]["acc_at_15m"] == pytest.approx(5 / 7)
    assert whole["after"]["error_max_m"] == pytest.approx(50.0, abs=0.01)
    assert whole["share_of_views"]["searching"] == pytest.approx(0.3)
    assert (whole["n_false_locks"], whole["first_s_max"]) == (1, 1.0)
    assert "consistency" not in whole
    assert "track" in plain["flights"]["long"] and "track" not in plain["flights"]["single"]
    said = summary(flights, total(flights))
    assert "track of long:" in said and "track of single:" not in said


def decoded(drawing: Drawing) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(drawing.png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def has_colour(image: np.ndarray, colour: str) -> bool:
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((np.abs(image - wanted).max(axis=2) < 25).sum() > 8)


@pytest.mark.long
def test_pictures_tell_states_apart_by_colour(monkeypatch) -> None:
    monkeypatch.setattr("orthonav.ground.report.drawing.DPI", 80)
    states = ["searching"] * 10 + ["tracking"] * 10 + ["coasting"] * 5 + ["lost"] * 5
    comparison, results = flown(drawn(30), states)
    track = measure_track(comparison, results, 15.0)
    image = decoded(track_map_picture(comparison, track.series, 15.0))
    assert all(has_colour(image, colour) for colour, _ in STATE_STYLES.values())
    lost = replace(track.series, states=("lost",) * 30)
    image = decoded(error_picture(comparison, lost, 15.0))
    assert not has_colour(image, STATE_STYLES["searching"][0])
    drawn_states = decoded(error_picture(comparison, track.series, 15.0))
    assert all(has_colour(drawn_states, colour) for colour, _ in STATE_STYLES.values())


# The contact sheet.


GRID = TileGrid(-200.0, 200.0, 1.0, 64, 16, 22, 22)
CAMERA = Camera(160, 120, 160.0, 160.0, 80.0, 60.0)


class Ground:
    """A sheet of one picture."""

    grid = GRID

    def __init__(self, grey: np.ndarray) -> None:
        self.grey = grey

    def crop(self, box, size_px):
        west, south, east, north = box
        (cols, rows), (left, top) = size_px, (west - GRID.west_m, GRID.north_m - north)
        steps = (east - west) / cols, (north - south) / rows
        matrix = np.array([[steps[0], 0, left], [0, steps[1], top]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        both = np.dstack([self.grey, np.ones_like(self.grey)])
        found = cv2.warpAffine(both, matrix, size_px, flags=flags)
        return found[..., 0], found[..., 1] > 0


class Picture:
    """A view whose picture is at hand, or cannot be read."""

    def __init__(self, frame: str, telemetry: Telemetry, grey: np.ndarray | None) -> None:
        self.frame, self.telemetry, self._grey, self.where = frame, telemetry, grey, "/x/a: b.jpg"

    def grey(self) -> np.ndarray:
        if self._grey is None:
            raise FlightError(f"image of the flight was cut short: {self.where}")
        return self._grey


class Seen:
    camera = CAMERA
    note = ""

    def __init__(self, views: list[Picture]) -> None:
        self.views, self.expected = views, len(views)


def seen_from(ground: np.ndarray, at_en_m, attitude) -> np.ndarray:
    """What the camera sees of the ground, whose first pixel is the corner of `GRID`."""
    px_from_ground = (
        CAMERA.matrix
        @ camera_from_en(*attitude)
        @ np.array(
            [
                [1.0, 0, GRID.west_m - at_en_m[0]],
                [0, -1.0, GRID.north_m - at_en_m[1]],
                [0, 0, 1.0],
            ]
        )
    )
    half = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return cv2.warpPerspective(ground, np.linalg.inv(half) @ px_from_ground @ half, (160, 120))


def contact(errors, states=None, **named) -> list[Row]:
    """Rows of views 40 m apart above a textured ground, turned by 90 deg, tilted by 8 deg."""
    ground = textured((400, 400), 3)
    n = len(errors)
    way = np.stack([40.0 * np.arange(n) - 60.0, np.full(n, 10.0)], axis=1)
    comparison, results = flown(errors, states, displacement_en_m=way, **named)
    attitude = 90.0, 8.0, 0.0, 100.0
    telemetry = Telemetry(0, 84.0, 8.0, 0.0, 108.0)  # heading and height are those of the fix
    views = [
        Picture(result.frame, telemetry, seen_from(ground, at, attitude))
        for result, at in zip(results, way, strict=True)
    ]
    return worst_rows(comparison, results, Seen(views), Ground(ground))


def alike(one, other) -> float:
    """Correlation of two pictures of one window where both are known."""
    both = ~(np.ma.getmaskarray(one) | np.ma.getmaskarray(other))
    assert both.sum() > 2000
    return float(np.corrcoef(one.data[both], other.data[both])[0, 1])


def test_views_and_map_are_shown_north_up_at_one_scale() -> None:
    (row,) = contact([(25.0, -15.0)])
    assert alike(row.view, row.at_truth) > 0.9
    assert alike(row.view, row.at_estimate) < 0.4
    np.testing.assert_allclose(row.shift_en_m, [25.0, -15.0], atol=0.01)
    (right,) = contact([(0.0, 0.0)])
    assert alike(right.view, right.at_estimate) > 0.9


def test_the_worst_come_first_and_tracking_before_others() -> None:
    errors = [(900.0, 0.0), (3.0, 0.0), None, (70.0, 0.0), (5.0, 0.0)]
    states = ["searching", "tracking", "tracking", "tracking", "lost"]
    comparison, results = flown(errors, states)
    assert worst_first(comparison, results) == [3, 1, 0, 4]
    assert worst_first(comparison, results, 2) == [3, 1]
    untracked, results = flown(errors, None)
    assert worst_first(untracked, results) == [0, 3, 4, 1]
    rows = contact(errors, states)
    assert [row.frame for row in rows] == ["0003.jpg", "0001.jpg", "0000.jpg", "0004.jpg"]
    assert "error 70.0 m" in row_text(rows[0]) and "tracking" in row_text(rows[0])
    assert rows[2].at_estimate.mask.all()  # beside the map
    image = decoded(sheet_picture(rows[1:2]))
    assert has_colour(image, "#0072B2") and has_colour(image, "#D55E00")


def test_the_reason_is_given_for_a_view_that_cannot_be_shown(coarse) -> None:
    ground = Ground(textured((400, 400), 3))
    comparison, results = flown([(1.0, 0.0)] * 5, None, cov_en_m2=np.ones((2, 2)))
    results[3] = replace(results[3], outcome=replace(results[3].outcome, agl_m=math.nan))
    telemetry = Telemetry(0, 90.0, 0.0, 0.0, 100.0)
    grey = np.zeros((120, 160), np.uint8)
    views = [
        Picture("0000.jpg", telemetry, None),
        Picture("0001.jpg", telemetry, grey[:50]),
        Picture("0003.jpg", replace(telemetry, agl_m=math.nan), grey),
        Picture("0004.jpg", telemetry, grey),
    ]
    rows = {row.frame: row for row in worst_rows(comparison, results, Seen(views), ground)}
    why = [rows[f"{i:04d}.jpg"].why_not for i in range(5)]
    assert why[0] == "image of the flight was cut short"
    assert "proportions" in why[1] and "not in the flight" in why[2] and "agl_m" in why[3]
    assert why[4] == "" and rows["0000.jpg"].view is None
    assert "sigma unknown" in row_text(rows["0000.jpg"])
    decoded(sheet_picture(list(rows.values())[:2]))
    decoded(sheet_picture([]))


# The command.


@pytest.fixture(scope="module")
def golden_flight(tmp_path_factory) -> tuple[Path, Path]:
    """A tracked flight over the map that lies with the tests: its folder and its fixes."""
    folder = tmp_path_factory.mktemp("track")
    opened = open_map(GOLDEN)
    sheet, layer = opened.manifest.sheets[0], GreyLayer.of(opened)
    errors = [(60.0, 0.0), (2.0, 1.0), (-3.0, 1.0), (1.0, -4.0)]
    states = ["searching", *["tracking"] * 3]
    way = np.array([(-60.0 + 30 * i, 0.0) for i in range(4)])
    _, results = flown(errors, states, displacement_en_m=way, local=sheet.frame)
    (folder / "flight").mkdir()
    writer = FlightWriter(folder / "flight", Camera(96, 96, 96.0, 96.0, 48.0, 48.0), "")
    for result, (east, north) in zip(results, way, strict=True):
        col = round(east - sheet.grid.west_m) - 48
        grey, _ = layer.read(0, round(sheet.grid.north_m - north) - 48, col, 96, 96)
        lat, lon = sheet.frame.latlon_from_en(np.array([east, north]))
        telemetry = Telemetry(result.time_ns, 0.0, 0.0, 0.0, 96.0)
        writer.add(result.frame, np.dstack([grey] * 3), telemetry, (float(lat), float(lon)))
    writer.close()
    write_results(folder / "fixes.jsonl", results)
    return folder / "flight", folder / "fixes.jsonl"


def evaluated(golden_flight, *more, capsys) -> tuple[int, str, str]:
    flight, fixes = golden_flight
    telemetry = ["evaluate", fixes, "--truth", flight / "truth.csv", *more]
    code = main([str(each) for each in telemetry])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.mark.long
def test_evaluate_a_track(golden_flight, tmp_path: Path, capsys, no_plots) -> None:
    flight = shutil.copytree(golden_flight[0], tmp_path / "flight")
    (flight / "frames" / "0002.jpg").write_bytes(b"no picture")  # said in its row
    report, out = tmp_path / "report", tmp_path / "metrics.json"
    more = ("--map", GOLDEN, "--report", report, "--flight", flight, "--metrics", out)
    code, said, wrong = evaluated(golden_flight, *more, capsys=capsys)
    assert (code, wrong) == (0, "") and "first confirmed fix: view 2 of 4" in said
    track = json.loads(out.read_text())["track"]
    assert (track["first_view"], track["first_s"], track["n_false_locks"]) == (2, 1.0, 1)
    assert isinstance(track["first_view"], int)
    html = (report / "index.html").read_text("utf-8")
    assert html.count("<figure") == 11 and "The worst views. 0003.jpg" in html
    assert (
        f"<code>orthonav view {golden_flight[1]} --map {GOLDEN} --flight {flight} --truth" in html
    )


def test_evaluate_refuses_flights_that_do_not_fit(golden_flight, tmp_path, capsys) -> None:
    flight, _ = golden_flight
    both = ("--map", GOLDEN, "--report", tmp_path / "r")
    for more, word in (
        (("--flight", flight, "--flight", flight, *both), "give --flight once per file"),
        (("--flight", tmp_path / "none", *both), "does not exist"),
    ):
        code, said, wrong = evaluated(golden_flight, *more, capsys=capsys)
        assert (code, said, wrong.count("\n")) == (1, "", 1) and word in wrong
    assert not (tmp_path / "r").exists()
