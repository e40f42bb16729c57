"""The fit of the benchmark of trust."""

import numpy as np
import pytest
from benchmarks.integrity import fit_judge

from orthonav.core.localize.confidence import DEFAULT_CHANCES, FEATURES, RegisteredConfidence

TRUE = RegisteredConfidence((-2.0, -1.0), (1.0, 2.0, 1.5, 0.5, 1.0, 2.0, 1.0), DEFAULT_CHANCES)


def views(count, seed):
    """Features (N, 7) and whether each view is right (N,), by `TRUE`."""
    rng = np.random.default_rng(seed)
    features = rng.normal(0.5, 1.0, (count, len(FEATURES)))
    features[:, 5] = features[:, 4]  # phase counts in both factors
    chance = np.array([TRUE.of(each) for each in features])
    return features, rng.uniform(size=count) < chance


def loss(judge, features, right):
    said = np.clip([judge.of(each) for each in features], 1e-9, 1 - 1e-9)
    return -np.log(np.where(right, said, 1 - said)).mean()


@pytest.mark.parametrize("outlier", [None, -60.0])
def test_the_fit_is_as_good_as_the_truth(outlier):
    features, right = views(2000, seed=1)
    assert 0.2 < right.mean() < 0.5
    if outlier is not None:  # a right view that nothing speaks for: its loss is limited
        features[np.flatnonzero(right)[0], 3] = outlier
    found = fit_judge(features, right)
    assert min(found.weights) >= 0
    assert loss(found, features, right) <= loss(TRUE, features, right) + 1e-3
    unseen, outcome = views(2000, seed=2)
    assert loss(found, unseen, outcome) < loss(TRUE, unseen, outcome) + 0.02
