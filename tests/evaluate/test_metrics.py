"""Figures of an evaluation against cases worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from erring_flights import flown

from orthonav.core.errors import FlightError
from orthonav.core.flight.fixes import write_results
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import NoFix, ViewResult
from orthonav.ground.evaluate.metrics import CRITERIA, compare, measure, worst_views
from orthonav.ground.evaluate.statistics import standard_figures, upper_bound
from orthonav.ground.evaluate.tables import metrics_to_json, verdict

PLACES_EN_M = [(0.0, 0.0), (100.0, 0.0), (200.0, 50.0), (300.0, 50.0)]
STRAY = ViewResult("z", 0, NoFix("blank", ""), 1.0)


def views(*errors_en_m, places_en_m=PLACES_EN_M, **known):
    """Truth and results of the first places; without confidence, right within 15 m."""
    known = {"confidence": math.nan, "radius_m": 15.0, "cov_en_m2": np.eye(2)} | known
    return flown(errors_en_m, places_en_m=places_en_m[: len(errors_en_m)], **known)


def three_fixes():
    """Errors 5, 10 and 500 m and one view without a fix."""
    errors = (3.0, 4.0), (-6.0, 8.0), None, (300.0, -400.0)
    evidence = [{"lowe_ratio": 1.2}, {"lowe_ratio": 1.0}]
    return compare(*views(*errors, confidence=[0.95, 0.6, math.nan, 0.6], evidence=evidence))


def test_shares_are_of_all_views_or_of_fixes():
    metrics = measure(three_fixes(), 6.0)
    assert (metrics.n_views, metrics.n_fixes, metrics.coverage) == (4, 3, 0.75)
    assert (metrics.acc_at_m[6.0], metrics.acc_at_m[15.0]) == (0.25, 0.5)
    assert (metrics.acc_fixes_at_m[6.0], metrics.acc_fixes_at_m[15.0]) == (1 / 3, 2 / 3)
    assert (metrics.accuracy, metrics.accuracy_of_fixes) == (0.25, 1 / 3)
    assert metrics.reasons == {"blank": 1}


def test_criteria_keep_views_at_or_above_a_threshold():
    rows = {(r.name, r.threshold): r for r in measure(three_fixes()).criteria}
    assert set(rows) == set(CRITERIA)
    kept = {key: (row.share_accepted, row.accuracy) for key, row in rows.items()}
    assert kept["lowe_ratio", 1.13] == kept["confidence", 0.9] == (0.25, 1.0)
    assert kept["confidence", 0.5] == (0.75, 2 / 3)
    share, accuracy = kept["confidence", 0.99]
    assert share == 0.0 and math.isnan(accuracy)


def test_all_is_defined_without_any_fix():
    truth, results = views(None, None, (0.0, 0.0), (0.0, 0.0))
    results[1] = replace(results[1], outcome=NoFix("too_dark", ""))
    metrics = measure(compare(truth, results[:2]))
    assert (metrics.coverage, metrics.accuracy, metrics.n_fixes) == (0.0, 0.0, 0)
    standard = metrics.standard
    undefined = metrics.accuracy_of_fixes, standard.cep50_m, standard.ape.mean_m, standard.ape.max_m
    assert all(map(math.isnan, undefined))
    assert metrics.reasons == {"blank": 1, "too_dark": 1, "no_result": 2}
    assert worst_views(compare(truth, results[:1])) == []


@pytest.mark.parametrize("local", [None, LocalFrame(0.0, 0.0)])
def test_errors_do_not_depend_on_a_place_far_away(local):
    """A first view before the receiver knew its position, or a map of another country."""
    truth, results = views((3.0, 4.0), (0.0, 5.0), (0.0, 10.0), (8.0, 6.0))
    found = compare(truth | {"0000.jpg": (0.0, 0.0)}, results, local).errors_m
    assert found[1:] == pytest.approx([5.0, 10.0, 10.0], abs=0.01) and found[0] > 1e6


def test_what_has_no_partner_is_counted_and_left_out():
    truth, results = views(*[(0.0, 0.0)] * 4)
    metrics = measure(compare(truth | {"0000.jpg": (math.nan, 0.0)}, [*results[:2], STRAY]))
    assert (metrics.n_views, metrics.n_without_truth, metrics.n_without_result) == (3, 2, 2)
    assert metrics.coverage == metrics.accuracy == 1 / 3 and metrics.reasons == {"no_result": 2}


def test_what_cannot_be_compared_is_refused():
    truth, results = views((0.0, 0.0))
    for known, given, message in (
        (truth, [STRAY], r"'z'.*'0000.jpg'"),
        ({}, [], "0 results"),
        (truth, results * 2, "more than one result"),
    ):
        with pytest.raises(FlightError, match=message):
            compare(known, given)
    for risk in (-0.1, 7.0, math.nan):
        with pytest.raises(ValueError, match="risk is a probability, 0 to 1"):
            compare(*views(None), risk=risk)
    for radius_m in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="radius"):
            measure(three_fixes(), radius_m)


def test_confident_and_wrong_is_distinguished_from_a_wrong_guess():
    """Wrong is above 35 m, the radius of the evaluation and the radius that the fix states."""
    guess = measure(three_fixes())
    assert (guess.n_confident, guess.n_confident_wrong) == (1, 0)
    said = "No confident fix is wrong: none of 1 is off by more than 35 m or its"
    assert verdict(guess).startswith(said) and "largest 5.0 m" in verdict(guess)
    truth, results = views((0.0, 40.0), (0.0, 30.0), confidence=0.95)
    wrong = compare(truth, results)
    assert worst_views(replace(wrong, errors_m=np.array([40.0, 50.0]))) == [1, 0]
    assert worst_views(replace(wrong, errors_m=np.array([36.0, 35.0]))) == [0, 1]
    said = "1 of 2 confident fixes is WRONG, off by more than 35 m or its radius"
    assert verdict(measure(wrong)).startswith(said)
    wider = replace(wrong, own_radius_m=np.array([45.0, 45.0]))
    assert measure(wider).n_confident_wrong == measure(wrong, 41.0).n_confident_wrong == 0
    none = measure(compare(*views((0.0, 0.0), confidence=0.5)))
    assert verdict(none).startswith("No fix is confident") and "1 are best guesses" in verdict(none)
    marked = [replace(result, accepted=False) for result in results]
    assert measure(compare(truth, marked)).n_confident == 0


def test_the_bound_of_a_rate_is_exact():
    assert upper_bound(0, 198) == pytest.approx(0.015, abs=1e-4)
    assert upper_bound(1, 40) == pytest.approx(0.1132, abs=1e-4)
    assert upper_bound(198, 198) == 1.0 and math.isnan(upper_bound(0, 0))


def test_confident_fixes_and_gaps_have_figures_of_their_own():
    """Confident at 0 s alone: the gap lasts from the second view to the last, 1 to 3 s."""
    found = measure(three_fixes())
    assert (found.availability, found.of_confident.cep95_m) == (0.25, pytest.approx(5.0))
    assert found.availability_95[0] < 0.25 < found.availability_95[1]
    assert found.gap.seconds_s == pytest.approx(2.0)
    assert found.gap.path_m == pytest.approx(math.hypot(100, 50) + 100, rel=1e-3)


PATH = np.array([[0.0, 0.0], [60.0, 0.0], [120.0, 0.0], [180.0, 0.0], [240.0, 0.0]])
ERRORS = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, np.nan], [0.0, 10.0], [0.0, -5.0]])
"""Errors of 5, 0, none, 10 and 5 m."""


def test_pose_errors_of_the_example():
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


def integrity(truth, results, limit_m=35.0, **risk):
    found = measure(compare(truth, results, **risk), 15.0, limit_m).integrity
    assert found is not None
    return found


def test_availability_and_false_fixes_at_an_alert_limit():
    """Five views, 1, 1, 1 and 7 s apart: two of them available, one of these false, one of three
    errors beyond its protection level; an outage from the second view to the fourth."""
    cov = [np.eye(2), 400.0 * np.eye(2), None, np.eye(2), None]
    flight = views(
        *((40.0, 0.0), (3.0, 0.0), None, (3.0, 0.0), None),
        places_en_m=[*PLACES_EN_M, (300.0, 150.0)],
        times_s=[0, 1, 2, 3, 10],
        cov_en_m2=cov,
        place_probability=0.9999,
    )
    found = integrity(*flight)
    assert found.risk == 1e-3
    assert (found.n_levels, found.n_beyond, found.beyond) == (3, 1, pytest.approx(1 / 3))
    assert found.beyond_upper_95 == pytest.approx(upper_bound(1, 3))
    assert (found.n_available, found.availability) == (2, 0.4)
    assert found.availability_of_time == pytest.approx(0.8)
    assert found.outage.seconds_s == 2.0 and found.outage.path_m == pytest.approx(211.8, abs=0.1)
    assert (found.n_false, found.false_upper_95) == (1, pytest.approx(upper_bound(1, 2)))
    assert measure(three_fixes()).integrity is None  # they state no place probability
    plain = metrics_to_json(measure(compare(*flight), 15.0, 35.0))["integrity"]
    assert plain["alert_limit_m"] == 35.0 and plain["outage"]["seconds_s"] == 2.0
    without = integrity(*flight, limit_m=math.nan, risk=1e-5)
    assert without.n_levels == 0  # wrong places are likelier
    assert math.isnan(without.availability) and math.isnan(without.outage.seconds_s)


def test_an_image_that_was_dropped_counts_as_an_outage_up_to_the_next_view():
    """One of four views, 1 s apart, has no result: the outage lasts from the view before it to
    the view after it. Beyond the first and the last result the times are unknown."""
    truth, results = views(*[(3.0, 0.0)] * 4, place_probability=0.9999)
    del results[2]
    found = integrity(truth, results)
    assert found.availability == 0.75 and found.availability_of_time == pytest.approx(1 / 3)
    assert found.outage.seconds_s == 2.0 and found.outage.path_m == pytest.approx(206.2, abs=0.1)
    for ends in (results[:2], results[1:]):
        cut = integrity(truth, ends)
        assert math.isnan(cut.outage.seconds_s + cut.availability_of_time)


def test_fixes_of_earlier_files_are_judged_by_their_confidence():
    truth, results = views(*[(3.0, 4.0)] * 4, confidence=[0.9999, 0.95, 0.5, 0.5])
    found = integrity(truth, results[:2])
    assert (found.n_available, found.availability) == (1, 0.25)
    assert math.isnan(found.availability_of_time)  # two views have no result


def test_a_truth_by_which_most_confident_fixes_are_wrong_is_doubted(tmp_path, run):
    """Of another flight, or a displaced map: false fixes are few."""
    fixes, table = tmp_path / "fixes.jsonl", tmp_path / "truth.csv"
    for confidences, said in (([0.95, 0.95, 0.95], "2 of 3"), ([0.95, 0.95, 0.5], "")):
        truth, results = views((0.0, 3.0), (0.0, 700.0), (0.0, 600.0), confidence=confidences)
        rows = [f"{name},{lat!r},{lon!r}" for name, (lat, lon) in truth.items()]
        table.write_text("\n".join(["frame,lat_deg,lon_deg", *rows]) + "\n")
        write_results(fixes, results)
        done = run("evaluate", fixes, "--truth", table)
        assert done.code == 0 and done.err.startswith(f"WARNING: {said}" if said else "")
        assert ("of the same flight, and is the map" in done.err) == bool(said)
