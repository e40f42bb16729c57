"""Go, marginal or no-go: every rule alone, and figures that agree with the verdict."""

import math
import re
from dataclasses import replace

import made_check
import numpy as np
import pytest
from made_check import CONDITIONS, flown, straight

from orthonav.core.errors import UsageError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.check.findings import RULES, Findings, verdict_of
from orthonav.ground.check.layers import check_to_plain
from orthonav.ground.check.records import CheckRequest, Conditions, Range, Word
from orthonav.ground.check.wording import text

ALONG = straight([0.95] * 201, step_m=50.0, error_m=4.0)
FLOWN = flown(ALONG)
FINE = dict(
    mean=Range(0.9, 0.8, 0.95),
    flights=None,
    conditions=CONDITIONS,
    calibrated=True,
    wrong=0,
    trials=1000,
    outside=0.0,
    after_fix_m=Range(30.0, 25.0, 35.0),
    view_px=200.0,
    prior_px=50.0,
    second_date=False,
)


def judged(findings):
    """The verdict, and the word of each reason."""
    verdict = verdict_of(Findings(**findings))
    ranks = [(Word.NO_GO, Word.MARGINAL, Word.GO).index(each.word) for each in verdict.reasons]
    assert ranks == sorted(ranks) and verdict.word is verdict.reasons[0].word
    assert all(each.text and "nan" not in each.text for each in verdict.reasons)
    return verdict.word, {each.code: each.word for each in verdict.reasons}


def flights(**changed):
    return dict(flights=replace(FLOWN, **changed))


RARE = replace(CONDITIONS, risk=1e-5)
LOW = replace(CONDITIONS, width_m=66.0, height_m=50.0, agl_m=60.0, speed_mps=20.0)
OBLIQUE = replace(CONDITIONS, camera_pitch_deg=14.0)
GO, MARGINAL, NO_GO = Word.GO, Word.MARGINAL, Word.NO_GO


@pytest.mark.parametrize(
    ("findings", "code", "word"),
    [
        (dict(mean=Range(0.7, 0.6, 0.8)), "fixes", GO),
        (dict(mean=Range(0.9, 0.59, 0.95)), "few_fixes", MARGINAL),
        (dict(mean=Range(0.28, 0.2, 0.73)), "few_fixes", MARGINAL),
        (dict(mean=Range(0.28, 0.05, 0.73)), "few_fixes", NO_GO),
        (dict(mean=Range(0.9, 0.61, 0.99)), "uncertain", None),
        (dict(mean=Range(0.7, 0.3, 0.9)), "uncertain", MARGINAL),
        (dict(mean=Range(0.7, 0.3, 0.9), second_date=True), "uncertain", None),
        (dict(view_px=130.0), "uncertain", None),
        (dict(view_px=130.0, prior_px=math.inf), "uncertain", MARGINAL),
        (dict(view_px=130.0, prior_px=150.0), "uncertain", MARGINAL),
        (dict(view_px=130.0, prior_px=150.0, second_date=True), "uncertain", None),
        (dict(calibrated=False), "no_confidence", NO_GO),
        (dict(wrong=1, trials=10), "wrong", None),
        (dict(wrong=4), "wrong", None),
        (dict(wrong=10), "wrong", MARGINAL),
        (dict(wrong=21), "wrong", NO_GO),
        (flights() | dict(outside=0.004), "outside_map", None),
        (flights() | dict(outside=0.05), "outside_map", MARGINAL),
        (flights() | dict(outside=0.11), "outside_map", NO_GO),
        (flights(), "availability", GO),
        (flights(availability=Range(0.9, 0.79, 0.95)), "availability", MARGINAL),
        (flights(availability=Range(0.9, 0.49, 0.95)), "availability", NO_GO),
        (flights(outage_s=Range(20, 10, 59)), "outage", GO),
        (flights(outage_s=Range(20, 10, 61)), "outage", MARGINAL),
        (flights(outage_s=Range(20, 10, 601)), "outage", NO_GO),
        (flights(false_fix=Range(0.005, 0, 0.01)), "wrong", GO),
        (flights(false_fix=Range(0.05, 0, 0.1)), "wrong", MARGINAL),
        (flights(false_fix=Range(0.05, 0, 0.11)), "wrong", NO_GO),
        (dict(after_fix_m=Range(50, 41, 60)), "availability", NO_GO),
        (dict(after_fix_m=Range(30, 25, 41)), "availability", MARGINAL),
        (dict(after_fix_m=Range(50, 39, 60)), "availability", MARGINAL),
        (dict(after_fix_m=Range(30, 25, 40)), "availability", GO),
        (dict(after_fix_m=Range(*[math.inf] * 3)), "availability", NO_GO),
        (flights() | dict(conditions=replace(CONDITIONS, risk=0.0003)), "risk", None),
        (flights() | dict(conditions=RARE), "risk", MARGINAL),
        (flights() | dict(conditions=RARE), "availability", None),
        (dict(conditions=RARE), "risk", MARGINAL),
        (dict(unknown=1.0), "surface", GO),
        (dict(unknown=1.0, conditions=OBLIQUE), "no_surface", GO),
        (dict(conditions=replace(CONDITIONS, camera_pitch_deg=30.0)), "oblique", MARGINAL),
        (dict(unknown=0.05, objects=0.9, conditions=OBLIQUE), "surface", GO),
        (dict(unknown=1.0, conditions=LOW), "houses", MARGINAL),
        (dict(unknown=1.0, conditions=replace(LOW, relief_m=0.0)), "surface", GO),
        (dict(objects=0.2, conditions=replace(LOW, relief_m=0.0)), "houses", MARGINAL),
        (dict(objects=0.05, conditions=LOW), "surface", GO),
        (dict(objects=0.05, unknown=0.06, conditions=LOW), "houses", MARGINAL),
        (dict(unknown=1.0, conditions=replace(CONDITIONS, camera_pitch_deg=14.0)), "oblique", None),
    ],
    ids=str,
)
def test_every_rule(findings, code, word):
    found, reasons = judged(FINE | findings)
    assert reasons.get(code) is word
    assert found is (word or found)


def test_houses_are_displaced_by_the_tangent_of_the_angle():
    """8 m by 8 m at 45 deg off nadir; and no farther than 80 deg."""
    square = replace(CONDITIONS, width_m=100.0, height_m=100.0, agl_m=50.0)
    assert square.displaced_share == pytest.approx(0.08)
    steep = replace(square, camera_pitch_deg=65.0)
    assert steep.displaced_share == pytest.approx(0.08 * math.tan(math.radians(80.0)))


def along_a_route(**changed):
    cells, ends = made_check.made_cells(4, 4, 50.0), ALONG.points_en_m[[0, -1]]
    return made_check.made_check(LocalFrame(48.0, 2.0), cells, ends, outages=(), **changed)


@pytest.mark.parametrize(
    ("probability", "limit_m", "scenes_std", "word"),
    [
        (0.97, 80.0, 0.3, GO),
        (0.7, 35.0, 0.8, None),
        (0.1, 35.0, 0.5, NO_GO),
        (0.25, 35.0, 1.5, None),
        (0.97, 10.0, 0.3, NO_GO),
    ],
    ids=["good", "fair", "low and narrow", "uncertain", "a fix beyond the limit"],
)
def test_nothing_contradicts_the_verdict(probability, limit_m, scenes_std, word):
    """Figures, reasons and JSON are of the same flights: GO only if all meet its thresholds."""
    along = replace(ALONG, probability=np.full(201, probability))
    conditions = replace(LOW, alert_limit_m=limit_m)
    found = flown(along, conditions, scenes_std)
    findings = FINE | dict(mean=found.probability, flights=found, conditions=conditions)
    verdict = verdict_of(Findings(**findings))
    assert verdict.word is word or (word is None and verdict.word is not GO)
    result = along_a_route(
        conditions=conditions, along=along, flights=found, verdict=verdict, mean=found.probability
    )
    plain = check_to_plain(result)
    flown_in, points = plain["flights"], plain["route"]["points"]
    assert plain["summary"]["mean_probability"] == pytest.approx(
        flown_in["probability"]["median"], abs=1e-3
    )
    lengths_m = np.gradient(points["distance_m"])
    mean = np.average(points["available"], weights=lengths_m)
    low, high = (flown_in["availability"][end] for end in ("low", "high"))
    assert low - 0.05 <= mean <= high + 0.05
    meets = low >= RULES.availability.go and flown_in["outage_s"]["high"] <= RULES.outage_s.go
    meets = meets and flown_in["probability"]["low"] >= RULES.fixes.go
    assert (verdict.word is GO) == meets
    said = text(result)
    assert ("can be flown" in said) == (verdict.word is GO)
    shown, low, high = re.search(r"(\d+ %)  availability \((\d+) % to (\d+) %", said).groups()
    reason = next(each.text for each in verdict.reasons if each.code == "availability")
    assert f"{shown} ({low} % to {high} %)" in reason


def test_a_rare_risk_has_no_availability():
    found = flown(ALONG, RARE)
    assert all(map(math.isnan, (*found.availability, *found.outage_s, *found.available)))
    assert found.false_fix == FLOWN.false_fix and found.error_95_m == FLOWN.error_95_m
    result = along_a_route(conditions=RARE, along=ALONG, flights=found)
    assert "-  availability: at a risk of 1e-05 too few" in text(result)
    plain = check_to_plain(result)
    assert plain["flights"]["availability"] == {"median": None, "low": None, "high": None}


def test_limits_are_those_of_the_command():
    """And the default is a figure that people would state."""
    out = {"alert_limit_m": 0.5}, {"alert_limit_m": 2e5}, {"risk": 1e-7}, {"camera_pitch_deg": 66.0}
    for asked in out:
        with pytest.raises(UsageError, match=next(iter(asked))):
            CheckRequest("area.onav", **asked)
    for agl_m, limit_m in ((270.0, 35.0), (2506.668, 63.0)):
        assert Conditions.of(CheckRequest("area.onav"), agl_m, 35.0).alert_limit_m == limit_m
