"""Go, marginal or no-go: every rule alone."""

from dataclasses import replace

import numpy as np
import pytest

from orthonav.ground.check.findings import Findings, verdict_of
from orthonav.ground.check.outcome import Along, BlindStretch, Word

ZEROS = np.zeros(11)
ALONG = Along(
    np.linspace(0, 5000, 11),
    np.zeros((11, 2)),
    probability=ZEROS + 0.9,
    low=ZEROS + 0.8,
    high=ZEROS + 0.95,
    across_low=ZEROS + 0.8,
    error_m=ZEROS + 3,
    drift_m=ZEROS + 8,
)
FINE = dict(
    mean=0.9,
    low=0.8,
    calibrated=True,
    wrong=0,
    trials=1000,
    outside=0.0,
    along=None,
    stretches=(),
    lookalikes=(),
    changed=0.0,
    allowed_m=50.0,
    predicted_px=256.0,
)
FLOWN = FINE | {"along": ALONG}


def judged(findings):
    """The verdict, and the word of each reason."""
    verdict = verdict_of(Findings(**findings))
    ranks = [(Word.NO_GO, Word.MARGINAL, Word.GO).index(each.word) for each in verdict.reasons]
    assert ranks == sorted(ranks) and verdict.word is verdict.reasons[0].word
    assert all(each.text and "nan" not in each.text for each in verdict.reasons)
    return verdict.word, {each.code: each.word for each in verdict.reasons}


def stretch(length_m, drift_m, *, ends_lost=False, allowed_m=50.0, start_m=1000.0):
    end_m = start_m + length_m
    return BlindStretch(
        start_m, end_m, start_m / 20, end_m / 20, 0.2, drift_m, allowed_m, ends_lost=ends_lost
    )


@pytest.mark.parametrize(
    ("allowed_m", "predicted_px", "word"),
    [
        (None, 130.0, Word.MARGINAL),
        (None, 150.0, Word.GO),
        (50.0, 130.0, Word.GO),
        (None, None, Word.GO),  # tried on a second date
    ],
)
def test_predictions_alone_are_no_go_for_narrow_views_without_a_prior(
    allowed_m, predicted_px, word
):
    found, reasons = judged(FINE | dict(allowed_m=allowed_m, predicted_px=predicted_px))
    assert found is word and ("narrow_views" in reasons) == (word is Word.MARGINAL)


@pytest.mark.parametrize(
    "mean, low, code, word",
    [
        (0.7, 0.6, "fixes", Word.GO),
        (0.99, 0.59, "few_fixes", Word.MARGINAL),
        (0.2, 0.1, "few_fixes", Word.MARGINAL),
        (0.19, 0.1, "few_fixes", Word.NO_GO),
        (0.0, 0.0, "few_fixes", Word.NO_GO),
    ],
)
def test_go_rests_on_the_low_end(mean, low, code, word):
    assert judged(FINE | dict(mean=mean, low=low)) == (word, {code: word})


def test_a_map_without_confidence_is_no_go():
    word, reasons = judged(FLOWN | dict(calibrated=False))
    assert word is Word.NO_GO and reasons["no_confidence"] is Word.NO_GO


@pytest.mark.parametrize(
    "wrong, trials, expected",
    [
        (1, 10, None),
        (2, 1000, None),
        (5, 1000, Word.MARGINAL),
        (19, 1000, Word.MARGINAL),
        (20, 1000, Word.NO_GO),
        (0, 0, None),
    ],
)
def test_wrong_with_confidence(wrong, trials, expected):
    word, reasons = judged(FINE | dict(wrong=wrong, trials=trials))
    assert reasons.get("wrong") is expected and word is (expected or Word.GO)


@pytest.mark.parametrize(
    "outside, expected",
    [(0.0, None), (0.004, None), (0.05, Word.MARGINAL), (0.11, Word.NO_GO), (1.0, Word.NO_GO)],
)
def test_a_route_beyond_the_map(outside, expected):
    word, reasons = judged(FLOWN | dict(outside=outside))
    assert reasons.get("outside_map") is expected and word is (expected or Word.GO)


@pytest.mark.parametrize(
    "drift_m, prior_std_m, expected",
    [
        (50.0, 50.0, Word.GO),
        (51.0, 50.0, Word.MARGINAL),
        (101.0, 50.0, Word.NO_GO),
        (5000.0, None, Word.GO),
    ],
)
def test_expected_drift(drift_m, prior_std_m, expected):
    drift = np.where(np.arange(11) == 4, drift_m, 3.0)
    along = replace(ALONG, drift_m=drift)
    findings = FINE | dict(along=along, allowed_m=prior_std_m)
    assert judged(findings) == (expected, {"fixes": Word.GO, "drift": expected})
    assert any("at km 2.0" in each.text for each in verdict_of(Findings(**findings)).reasons)


@pytest.mark.parametrize(
    "stretches, expected, said",
    [
        (
            (stretch(400, 12),),
            Word.GO,
            "Gaps without fixes: 1, the longest 400 m (20 s), from km 1.0; dead",
        ),
        ((stretch(400, 12), stretch(900, 27)), Word.GO, "2, the longest 900 m"),
        ((stretch(2000, 60),), Word.MARGINAL, "dead reckoning drifts by 60 m (limit 50 m)"),
        ((stretch(4000, 120),), Word.NO_GO, "drifts by 120 m (limit 50 m)"),
        ((stretch(400, 12, ends_lost=True),), Word.MARGINAL, "the route ends in a gap"),
        ((stretch(400, 12), stretch(4000, 120)), Word.NO_GO, "fixes: 2"),
        ((stretch(9000, 270, allowed_m=float("inf")),), Word.GO, "bridges"),
    ],
    ids=["one", "two", "long", "longer", "at the end", "one of two", "whole map searched"],
)
def test_gaps(stretches, expected, said):
    findings = FLOWN | dict(stretches=stretches)
    word, reasons = judged(findings)
    assert word is expected and reasons["blind"] is expected
    assert any(said in each.text for each in verdict_of(Findings(**findings)).reasons)
