"""Figures of a track against cases worked out by hand and drawn by chance; what is shown of it."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from erring_flights import CENTRE, COV, drawn, flown

from orthonav.core.flight.fixes import write_results
from orthonav.core.flight.folder import FlightWriter
from orthonav.core.geo.camera import Camera
from orthonav.core.mapfile import open_map
from orthonav.core.records import Telemetry, ViewResult
from orthonav.ground.evaluate.metrics import Comparison, compare, measure
from orthonav.ground.evaluate.report import write_report
from orthonav.ground.evaluate.statistics import consistency
from orthonav.ground.evaluate.tables import (
    FlightReport,
    metrics_to_json,
    runs_to_json,
    summary,
    text,
)
from orthonav.ground.evaluate.track import (
    TrackMetrics,
    course_en,
    effective_number,
    measure_track,
)

GOLDEN = Path(__file__).parents[1] / "data" / "golden_v1.onav"


def compared(*arguments, local=CENTRE, **named) -> tuple[Comparison, list[ViewResult]]:
    truth, results = flown(*arguments, local=local, **named)
    return compare(truth, results, local), results


def tracked(*arguments, radius_m=15.0, **named) -> TrackMetrics:
    found = measure_track(*compared(*arguments, **named), radius_m)
    assert found is not None
    return found


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_of_twenty_consistent_tracks_about_one_is_called_otherwise(alike: float) -> None:
    found = [
        consistency(drawn(300, seed, alike), np.tile(COV, (300, 1, 1)), effective_number)
        for seed in range(60)
    ]
    assert sum(each.verdict == "consistent" for each in found) >= 53
    mean = np.mean([each.nees_mean for each in found])
    assert mean == pytest.approx(2.0, abs=0.15)
    small = consistency(drawn(300, 1, alike), np.tile(COV / 4, (300, 1, 1)), effective_number)
    assert small.verdict == "over-confident"


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


STATES = ["searching"] * 2 + ["tracking"] * 3 + ["lost"] * 2 + ["tracking"] * 2 + ["lost"]
SURE = [0.1, 0.99, 0.95, 0.95, 0.5, 0.2, 0.2, 0.95, 0.95, 0.1]
ERRORS = [None, (90.0, 0), (3.0, 0), (4, 0), (40, 0), (50, 0), (5, 0), (0, 70), (0, 61), (99, 0)]
TIMES_S = [0, 1, 3, 4, 5, 6, 16, 17, 18, 20]


def by_hand(**named) -> TrackMetrics:
    times_s = [1_700_000_000 + s for s in TIMES_S]
    return tracked(ERRORS, STATES, confidence=SURE, times_s=times_s, **named)


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
    assert track.low_confidence.seconds_s == 12.0
    assert track.low_confidence.path_m == pytest.approx(30.0, abs=0.01)
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


def test_ahead_and_right_are_positive_whatever_the_course() -> None:
    angle = np.linspace(0.0, 1.5 * math.pi, 60)
    course = np.stack([np.sin(angle), np.cos(angle)], axis=1)  # from north, clockwise
    way = 300.0 * np.stack([1 - np.cos(angle), np.sin(angle)], axis=1)
    right = np.stack([course[:, 1], -course[:, 0]], axis=1)
    track = tracked(4.0 * course - 2.0 * right, "tracking", places_en_m=way)
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
    there = np.stack([east, 0 * east], axis=1)
    track = tracked([(3.0, 1.0)] * 16, "tracking", places_en_m=there)
    assert track.along.n == 10
    random = np.random.default_rng(0)
    dense = np.stack([np.arange(400) * 0.2, random.normal(0.0, 0.1, 400)], axis=1)
    course = course_en(dense)
    assert np.isfinite(course).all() and course[20:-20, 0].min() > 0.98


@pytest.mark.parametrize(
    ("errors", "states", "named"),
    [
        ([(1.0, 0.0)], "tracking", {}),
        ([None], "searching", {}),
        ([None] * 5, "lost", {}),
        ([None] * 5, "tracking", {}),
        ([(1.0, 0.0)] * 5, "tracking", {"times_s": [5, 4, 3, 2, 1]}),
        ([(1.0, 0.0)] * 5, "lost", {"times_s": [7] * 5}),
        ([(1.0, 0.0)] * 5, "tracking", {"places_en_m": np.zeros((5, 2))}),
        ([(1.0, 0.0)] * 5, ["tracking", None, "lost", None, "searching"], {"unknown": (0, 1, 3)}),
        ([(1.0, 0.0)] * 5, "tracking", {"confidence": math.nan, "unknown": (0, 4)}),
        ([(1.0, 0.0)] * 5, "tracking", {"cov_en_m2": np.full((2, 2), math.nan)}),
        ([(1.0, 0.0)] * 5, "tracking", {"cov_en_m2": np.eye(2) * 1e-200}),
    ],
)
def test_odd_tracks_are_measured(errors, states, named) -> None:
    comparison, results = compared(errors, states, **named)
    track = measure_track(comparison, results, 15.0)
    assert track is not None
    flight = FlightReport("odd", comparison, measure(comparison), track=track)
    json.dumps(runs_to_json([flight]), allow_nan=False)
    shown = summary(flight).lower()
    assert "nan" not in shown and "inf" not in shown


def test_states_count_without_a_truth_and_errors_only_with_one() -> None:
    errors = [None, (500.0, 0.0), (3.0, 0.0), (3.0, 0.0), (70.0, 0.0)]
    states = ["searching", "searching", "tracking", "tracking", "tracking"]
    track = tracked(errors, states, unknown=(0, 1, 4), confidence=0.5)
    assert (track.n_views, track.first_view) == (5, 3)
    assert track.share_of_views["searching"] == 0.4
    assert track.after.n_views == 2 and track.n_false_locks == 0


def test_views_placed_one_by_one_have_no_track(tmp_path: Path, no_plots) -> None:
    comparison, results = compared([(1.0, 0.0)] * 4)
    assert measure_track(comparison, results, 15.0) is None
    flight = FlightReport("f", comparison, measure(comparison))
    assert runs_to_json([flight]) == metrics_to_json(flight.metrics)
    assert "track" not in summary(flight)
    html = write_report(tmp_path, [flight]).read_text("utf-8")
    assert "Track" not in html and html.count("<figure") == 3


def test_json_has_names_that_scripts_read() -> None:
    states = ["searching", *["tracking"] * 5]
    comparison, results = compared([(3.0, 4.0)] * 6, states)
    track = measure_track(comparison, results, 15.0)
    plain = runs_to_json([FlightReport("f", comparison, measure(comparison), track=track)])
    assert not plain.keys() & {"gap", "of_confident", "consistency", "integrity"}
    statistics = {"n", "rmse_m", "mean_m", "median_m", "std_m", "max_m"}
    for standard in (plain["standard"], plain["standard_of_confident"]):
        assert list(standard) == ["rmse_m", "cep50_m", "cep95_m", "ape", "rpe"]
        assert standard["rmse_m"] == pytest.approx(5.0) and set(standard["ape"]) == statistics
        assert [(each["delta"], each["unit"]) for each in standard["rpe"]] == [
            (1, "frames"),
            (100.0, "m"),
        ]
        assert set(standard["rpe"][0]) == statistics | {"delta", "unit"}
    nees = {"nees_mean", "nees_within_95", "n_effective", "effective_low", "effective_high"}
    covariance, consistency = plain["covariance"], plain["track"]["consistency"]
    counts = {"n_right", "n_nees", "n_without_covariance", "n_unusable_covariance"}
    within = {"nees_median", "nees_within_50", "nees_within_90", "nees_within_99"}
    assert covariance.keys() >= counts | nees | within
    assert (covariance["n_right"], covariance["n_nees"]) == (6, 6)
    assert consistency.keys() >= {"n_views", "n_left_out", "verdict"} | nees
    assert (consistency["n_views"], consistency["n_left_out"]) == (5, 0)
    for name in ("along", "across"):
        assert list(plain["track"][name]) == ["n_views", "mean_m", "std_m", "rmse_m"]
    assert plain["track"]["first_view"] == 2 and plain["track"]["after"]["acc_at_25m"] == 1.0
    assert not plain["track"].keys() & {"series"} and "seconds_s" in plain["track"]["over_time"]


def test_runs_of_one_flight_are_compared_and_never_counted_together() -> None:
    """Views twice would halve the bound of the rate of false fixes."""
    runs = []
    for name, states in (("tracked", ["searching", *["tracking"] * 5]), ("single", None)):
        comparison, results = compared([(2.0, 0.0)] * 6, states)
        track = measure_track(comparison, results, 15.0)
        runs.append(FlightReport(name, comparison, measure(comparison), track=track))
    plain = json.loads(json.dumps(runs_to_json(runs), allow_nan=False))
    assert list(plain) == ["runs"] and list(plain["runs"]) == ["tracked", "single"]
    assert plain["runs"]["single"] == runs_to_json(runs[1:]) and "track" in plain["runs"]["tracked"]
    said = text(runs)
    for name, views in (("tracked", 6), ("single", 6)):
        assert f"{name}: No confident fix is wrong: none of {views} is off by" in said
        assert f"\n{name}:\nviews with a confident fix: 100.0 %" in said
    assert "12" not in re.findall(r"\d+", said) and said.count("\ntrack:\n") == 1
    alone = text(runs[1:])
    assert alone.startswith("No confident fix is wrong") and "single:" not in alone


@pytest.fixture
def flight(tmp_path) -> Path:
    """A tracked flight over the map that lies with the tests, its fixes beside it."""
    frame = open_map(GOLDEN).manifest.sheets[0].frame
    way = np.array([(-60.0 + 30 * i, 0.0) for i in range(4)])
    errors = [(60.0, 0.0), (2.0, 1.0), (-3.0, 1.0), (1.0, -4.0)]
    states = ["searching", *["tracking"] * 3]
    _, results = flown(errors, states, places_en_m=way, local=frame)
    folder = tmp_path / "flight"
    folder.mkdir()
    writer = FlightWriter(folder, Camera(96, 96, 100.0, 100.0, 48.0, 48.0), "")
    for result, at in zip(results, way, strict=True):
        telemetry = Telemetry(result.time_ns, 84.0, 0.0, 0.0, 108.0)
        lat, lon = (float(value) for value in frame.latlon_from_en(at))
        writer.add(result.frame, np.zeros((96, 96, 3), np.uint8), telemetry, (lat, lon))
    writer.close()
    write_results(tmp_path / "fixes.jsonl", results)
    return folder


def test_evaluate_a_track(run, flight, tmp_path: Path, no_plots) -> None:
    fixes, report = (tmp_path / name for name in ("fixes.jsonl", "report"))
    more = ("--map", GOLDEN, "--report", report)
    done = run("evaluate", fixes, "--flight", flight, *more)
    assert (done.code, done.err) == (0, "")
    assert "first confirmed fix: view 2 of 4" in done.out
    track = json.loads(run("evaluate", fixes, "--flight", flight, "--json").out)["track"]
    assert (track["first_view"], track["first_s"], track["n_false_locks"]) == (2, 1.0, 1)
    assert isinstance(track["first_view"], int)
    html = (report / "index.html").read_text("utf-8")
    assert html.count("<figure") == 3 and "<td>0003.jpg</td>" in html
    assert f"<code>orthonav view {fixes} --map {GOLDEN} --flight {flight} " in html


def test_evaluate_refuses_flights_that_do_not_fit(run, flight, tmp_path: Path) -> None:
    fixes, report = tmp_path / "fixes.jsonl", ("--report", tmp_path / "r")
    for more, code, word in (
        (("--flight", flight, "--flight", flight), 2, "give --flight once per file"),
        (("--flight", tmp_path / "none"), 1, "does not exist"),
    ):
        done = run("evaluate", fixes, "--map", GOLDEN, *more, *report)
        assert (done.code, done.out, done.err.count("\n")) == (code, "", 1) and word in done.err
    assert not (tmp_path / "r").exists()
