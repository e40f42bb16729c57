"""Figures of an evaluation against cases worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.errors import FlightError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.evaluate.metrics import (
    CRITERIA,
    Comparison,
    compare,
    measure,
    worst_views,
)
from orthonav.ground.evaluate.statistics import standard_figures, upper_bound
from orthonav.ground.evaluate.tables import FlightReport, metrics_to_json, verdict

CENTRE = LocalFrame(48.0, -4.5)
TRUTH_EN_M = {"a": (0.0, 0.0), "b": (100.0, 0.0), "c": (200.0, 50.0), "d": (300.0, 50.0)}


def truth_of(places: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    found = {name: CENTRE.latlon_from_en(np.array(at)) for name, at in places.items()}
    return {name: (float(lat), float(lon)) for name, (lat, lon) in found.items()}


def fix(frame: str, offset_en_m: tuple[float, float], latency_ms: float = 10.0, **known: float):
    east, north = np.add(TRUTH_EN_M[frame], offset_en_m)
    lat, lon = CENTRE.latlon_from_en(np.array([east, north]))
    confidence = known.pop("confidence", math.nan)
    outcome = Fix(float(lat), float(lon), np.eye(2), confidence, 15.0, 0.0, 100.0, known)
    return ViewResult(frame, 0, outcome, latency_ms)


def no_fix(frame: str, reason: str = "blank") -> ViewResult:
    return ViewResult(frame, 0, NoFix(reason, "", {"lowe_ratio": 9.0}), 50.0)


def three_fixes() -> Comparison:
    """Errors 5, 10 and 500 m and one view without a fix."""
    results = [
        fix("a", (3.0, 4.0), 10.0, confidence=0.95, lowe_ratio=1.2),
        fix("b", (-6.0, 8.0), 20.0, confidence=0.6, lowe_ratio=1.0),
        no_fix("c"),
        fix("d", (300.0, -400.0), 30.0, confidence=0.6),
    ]
    return compare(truth_of(TRUTH_EN_M), results)


def test_shares_are_of_all_views_or_of_fixes() -> None:
    metrics = measure(three_fixes(), 6.0)
    assert (metrics.n_views, metrics.n_fixes) == (4, 3)
    assert metrics.coverage == 0.75
    assert (metrics.acc_at_m[6.0], metrics.acc_at_m[15.0]) == (0.25, 0.5)
    assert (metrics.acc_fixes_at_m[6.0], metrics.acc_fixes_at_m[15.0]) == (1 / 3, 2 / 3)
    assert (metrics.accuracy, metrics.accuracy_of_fixes) == (0.25, 1 / 3)
    assert metrics.reasons == {"blank": 1}


def test_criteria_keep_views_at_or_above_a_threshold() -> None:
    rows = {(r.name, r.threshold): r for r in measure(three_fixes()).criteria}
    assert set(rows) == set(CRITERIA)
    kept = {key: (row.share_accepted, row.accuracy) for key, row in rows.items()}
    assert kept["lowe_ratio", 1.13] == (0.25, 1.0)
    assert kept["confidence", 0.5] == (0.75, 2 / 3)
    assert kept["confidence", 0.9] == (0.25, 1.0)
    share, accuracy = kept["confidence", 0.99]
    assert share == 0.0 and math.isnan(accuracy)


def test_all_is_defined_without_any_fix() -> None:
    metrics = measure(compare(truth_of(TRUTH_EN_M), [no_fix("a"), no_fix("b", "too_dark")]))
    assert (metrics.coverage, metrics.accuracy, metrics.n_fixes) == (0.0, 0.0, 0)
    undefined = (metrics.accuracy_of_fixes, metrics.standard.cep50_m, metrics.standard.cep95_m)
    assert all(map(math.isnan, undefined))
    assert all(map(math.isnan, (metrics.standard.ape.mean_m, metrics.standard.ape.max_m)))
    assert metrics.reasons == {"blank": 1, "too_dark": 1, "no_result": 2}
    assert worst_views(compare(truth_of(TRUTH_EN_M), [no_fix("a")])) == []


def test_what_has_no_partner_is_counted_and_left_out() -> None:
    truth = {**truth_of(TRUTH_EN_M), "a": (math.nan, 0.0)}
    other = ViewResult("z", 0, NoFix("blank", ""), 1.0)
    metrics = measure(compare(truth, [fix("a", (0, 0)), fix("b", (0, 0)), other]))
    assert (metrics.n_views, metrics.n_without_truth, metrics.n_without_result) == (3, 2, 2)
    assert metrics.coverage == metrics.accuracy == 1 / 3 and metrics.reasons == {"no_result": 2}


def test_no_overlap_is_an_error_that_shows_both_names() -> None:
    with pytest.raises(FlightError, match=r"'z'.*'a'"):
        compare(truth_of(TRUTH_EN_M), [ViewResult("z", 0, NoFix("blank", ""), 1.0)])
    with pytest.raises(FlightError, match="0 results"):
        compare({}, [])


@pytest.mark.parametrize("radius_m", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_radius_is_refused(radius_m: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        measure(three_fixes(), radius_m)


def test_confident_and_wrong_is_distinguished_from_a_wrong_guess() -> None:
    """Wrong is above 35 m, the radius of the evaluation and the radius that the fix states."""
    guess = measure(three_fixes())
    assert (guess.n_confident, guess.n_confident_wrong) == (1, 0)
    assert verdict(guess).startswith(
        "No confident fix is wrong: none of 1 is off by more than 35 m or its"
    )
    assert "largest 5.0 m" in verdict(guess)
    results = [fix("a", (0.0, 40.0), confidence=0.95), fix("b", (0.0, 30.0), confidence=0.95)]
    wrong = compare(truth_of(TRUTH_EN_M), results)
    assert worst_views(replace(wrong, errors_m=np.array([40.0, 50.0]))) == [1, 0]
    assert worst_views(replace(wrong, errors_m=np.array([36.0, 35.0]))) == [0, 1]
    assert verdict(measure(wrong)).startswith(
        "1 of 2 confident fixes is WRONG, off by more than 35 m or its radius"
    )
    wider = replace(wrong, own_radius_m=np.array([45.0, 45.0]))
    assert measure(wider).n_confident_wrong == measure(wrong, 41.0).n_confident_wrong == 0
    none = measure(compare(truth_of(TRUTH_EN_M), [fix("a", (0.0, 0.0), confidence=0.5)]))
    assert verdict(none).startswith("No fix is confident") and "1 are best guesses" in verdict(none)
    marked = [replace(result, accepted=False) for result in results]
    assert measure(compare(truth_of(TRUTH_EN_M), marked)).n_confident == 0


def test_the_bound_of_a_rate_is_exact() -> None:
    assert upper_bound(0, 198) == pytest.approx(0.015, abs=1e-4)
    assert upper_bound(1, 40) == pytest.approx(0.1132, abs=1e-4)
    assert upper_bound(198, 198) == 1.0 and math.isnan(upper_bound(0, 0))


def test_confident_fixes_and_gaps_have_figures_of_their_own() -> None:
    """Confident at 0 s alone: the gap lasts from the second view to the last, 1 to 3 s."""
    comparison = replace(three_fixes(), time_ns=(0, 10**9, 2 * 10**9, 3 * 10**9))
    found = measure(comparison)
    assert (found.availability, found.of_confident.cep95_m) == (0.25, pytest.approx(5.0))
    assert found.availability_95[0] < 0.25 < found.availability_95[1]
    assert found.gap.seconds_s == pytest.approx(2.0)
    assert found.gap.path_m == pytest.approx(math.hypot(100, 50) + 100, rel=1e-3)


# APE, RPE, CEP.


PATH = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0], [180.0, 0.0], [240.0, 0.0]])
ERRORS = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, np.nan], [0.0, 10.0], [0.0, -5.0]])
"""Errors of 5, 0, none, 10 and 5 m."""


def test_pose_errors_of_the_example() -> None:
    """From fix to fix errors differ by (-3, -4), (0, 10), (0, -15). The fixes lie at 0, 60, 180 and
    240 m: 100 m are reached at 180 m, and no second time; at twice the scale at 120, 360, 480 m."""
    found = standard_figures(PATH, PATH + ERRORS)
    far = standard_figures(2 * PATH, 2 * PATH + ERRORS).rpe_distance
    expected = {  # n, RMSE, mean, median, std, max
        found.ape: (4, math.sqrt(37.5), 5.0, 5.0, math.sqrt(12.5), 10.0),
        found.rpe_frames: (3, math.sqrt(350 / 3), 10.0, 10.0, math.sqrt(50 / 3), 15.0),
        far: (2, math.sqrt(325 / 2), 12.5, 12.5, 2.5, 15.0),
    }
    for statistics, values in expected.items():
        assert tuple(vars(statistics).values()) == pytest.approx(values)
    assert found.rpe_distance.n == 0
    assert (found.cep50_m, found.cep95_m) == pytest.approx((5.0, 5 + 0.85 * (10 - 5)))


def placed(frame: str, second: int, std_m: float, error_m: float, place: float) -> ViewResult:
    result = fix(frame, (error_m, 0.0))
    outcome = replace(result.outcome, cov_en_m2=np.eye(2) * std_m**2, place_probability=place)
    return replace(result, outcome=outcome, time_ns=second * 10**9)


def test_availability_and_false_fixes_at_an_alert_limit() -> None:
    """Five views, 1, 1, 1 and 7 s apart: two of them available, one of these false, one of three
    errors beyond its protection level; an outage from the second view to the fourth."""
    truth = TRUTH_EN_M | {"e": (300.0, 150.0)}
    lost = replace(no_fix("c"), time_ns=2 * 10**9)
    last = replace(no_fix("e"), time_ns=10 * 10**9)
    results = [
        placed("a", 0, 1.0, 40.0, 0.9999),
        placed("b", 1, 20.0, 3.0, 0.9999),
        lost,
        placed("d", 3, 1.0, 3.0, 0.9999),
        last,
    ]
    found = measure(compare(truth_of(truth), results), 15.0, 35.0).integrity
    assert found is not None and found.risk == 1e-3
    assert (found.n_levels, found.n_beyond, found.beyond) == (3, 1, pytest.approx(1 / 3))
    assert found.beyond_upper_95 == pytest.approx(upper_bound(1, 3))
    assert (found.n_available, found.availability) == (2, 0.4)
    assert found.availability_of_time == pytest.approx(0.8)
    assert found.outage.seconds_s == 2.0 and found.outage.path_m == pytest.approx(211.8, abs=0.1)
    assert (found.n_false, found.false_upper_95) == (1, pytest.approx(upper_bound(1, 2)))
    flight = FlightReport("f", compare(truth_of(truth), results), measure(three_fixes()))
    assert flight.metrics.integrity is None  # they state no place probability
    plain = metrics_to_json(measure(flight.comparison, 15.0, 35.0))["integrity"]
    assert plain["alert_limit_m"] == 35.0 and plain["outage"]["seconds_s"] == 2.0
    without = measure(compare(truth_of(truth), results, risk=1e-5)).integrity
    assert without is not None and without.n_levels == 0  # wrong places are likelier
    assert math.isnan(without.availability) and math.isnan(without.outage.seconds_s)


def test_an_image_that_was_dropped_counts_as_an_outage_up_to_the_next_view() -> None:
    """One of four views, 1 s apart, has no result: the outage lasts from the view before it to
    the view after it. Beyond the first and the last result the times are unknown."""
    results = [placed(name, second, 1.0, 3.0, 0.9999) for name, second in (("a", 0), ("b", 1))]
    results.append(placed("d", 3, 1.0, 3.0, 0.9999))
    comparison = compare(truth_of(TRUTH_EN_M), results)
    found = measure(comparison, 15.0, 35.0).integrity
    assert found is not None and found.availability == 0.75
    assert found.availability_of_time == pytest.approx(1 / 3)
    assert found.outage.seconds_s == 2.0 and found.outage.path_m == pytest.approx(206.2, abs=0.1)
    for ends in (results[:2], results[1:]):
        cut = measure(compare(truth_of(TRUTH_EN_M), ends), 15.0, 35.0).integrity
        assert cut is not None and math.isnan(cut.outage.seconds_s + cut.availability_of_time)


def test_fixes_of_earlier_files_are_judged_by_their_confidence() -> None:
    sure = fix("a", (3.0, 4.0), confidence=0.9999)
    unsure = fix("b", (3.0, 4.0), confidence=0.95)
    found = measure(compare(truth_of(TRUTH_EN_M), [sure, unsure]), 15.0, 35.0).integrity
    assert found is not None and (found.n_available, found.availability) == (1, 0.25)
    assert math.isnan(found.availability_of_time)  # two views have no result
