"""Go, marginal or no-go: every rule alone."""

from dataclasses import replace

import numpy as np
import pytest

from orthonav.ground.check.findings import Findings, verdict_of
from orthonav.ground.check.records import Along, BlindStretch, Word

ZEROS = np.zeros(11)
ALONG = Along(
    distance_m=np.linspace(0, 5000, 11),
    points_en_m=np.zeros((11, 2)),
    probability=ZEROS + 0.9,
    low=ZEROS + 0.8,
    high=ZEROS + 0.95,
    across_low=ZEROS + 0.8,
    error_m=ZEROS + 3,
    drift_m=ZEROS + 8,
    wrong=ZEROS,
    persistence=ZEROS + 0.5,
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


def drifting(drift_m):
    return replace(ALONG, drift_m=np.where(np.arange(11) == 4, drift_m, 3.0))


GO, MARGINAL, NO_GO = Word.GO, Word.MARGINAL, Word.NO_GO


@pytest.mark.parametrize(
    ("findings", "code", "word"),
    [
        (dict(allowed_m=None, predicted_px=130.0), "narrow_views", MARGINAL),
        (dict(allowed_m=None, predicted_px=150.0), "narrow_views", None),
        (dict(allowed_m=50.0, predicted_px=130.0), "narrow_views", None),
        (dict(allowed_m=None, predicted_px=None), "narrow_views", None),
        (dict(mean=0.7, low=0.6), "fixes", GO),
        (dict(mean=0.99, low=0.59), "few_fixes", MARGINAL),
        (dict(mean=0.2, low=0.1), "few_fixes", MARGINAL),
        (dict(mean=0.19, low=0.1), "few_fixes", NO_GO),
        (dict(mean=0.0, low=0.0), "few_fixes", NO_GO),
        (dict(calibrated=False), "no_confidence", NO_GO),
        (dict(wrong=1, trials=10), "wrong", None),
        (dict(wrong=2), "wrong", None),
        (dict(wrong=5), "wrong", MARGINAL),
        (dict(wrong=19), "wrong", MARGINAL),
        (dict(wrong=20), "wrong", NO_GO),
        (dict(wrong=0, trials=0), "wrong", None),
        (dict(along=ALONG, outside=0.004), "outside_map", None),
        (dict(along=ALONG, outside=0.05), "outside_map", MARGINAL),
        (dict(along=ALONG, outside=0.11), "outside_map", NO_GO),
        (dict(along=drifting(50.0)), "drift", GO),
        (dict(along=drifting(51.0)), "drift", MARGINAL),
        (dict(along=drifting(101.0)), "drift", NO_GO),
        (dict(along=drifting(5000.0), allowed_m=None), "drift", GO),
        (dict(changed=0.05), "changed_ground", GO),
        (dict(changed=0.2), "changed_ground", MARGINAL),
    ],
    ids=str,
)
def test_every_rule(findings, code, word):
    found, reasons = judged(FINE | findings)
    assert reasons.get(code) is word and found is (word or GO)


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
