"""Confidence of a registered view: a probability from its scores, its rivals and its ground.

Weights are those of real imagery of two dates (`python -m benchmarks.trust`), scores of chance
those of the map.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.localize.logistic import probability

FEATURES = (
    "log_strength",
    "log_peak_ratio",
    "log_look_ratio",
    "log_detail_ratio",
    "log_local_phase",
    "log_alone_phase",
    "log_alone_gradients",
)
ALONE = 2
"""The last so many say whether the view fits nowhere near as well, the others whether it fits."""
CHANCES = ("total", "look", "fine")
CUT_SHORT = 0.89
"""Largest confidence of a view whose search ended early (`--budget-ms`) before a place stood out:
its rivals were not all looked for. Below `orthonav.core.records.CONFIDENT`."""
USUAL_BIASES = -6.68, -8.0
USUAL_WEIGHTS = 2.35, 4.29, 5.87, 2.7, 2.28, 4.05, 3.03
"""What separates right from wrong, fitted to 1,734 views (docs/decisions/confidence.md). The
benchmark of trust shows how weights fitted in this way judge scenes left out."""
RIDGE = 3e-2
"""Weight of the usual bias where views of another date of the map's area are fitted."""
MAX_SHIFT = 5.0
"""Largest change of the bias by them."""
LEAST = 1e-9
"""Least and greatest (1 - LEAST) probability of the fit, for a finite loss."""
STAND_IN = 0.7
"""Share of the chance value that stands in for a rival where a narrow search found none."""
LEAST_DEVIATIONS = 1.0
"""Least height above the ground nearby, in standard deviations, that makes a difference."""
USUAL_DETAIL = 1.4
"""Stands in for the detail ratio of views too small to be finished at a finer level."""


@dataclass(frozen=True)
class Chances:
    """Scores of the best place of a view that is not on the map, over the whole map.

    `total`: the levels it is judged and finished at; `look`: the first of them; `fine`: with one
    more.
    """

    total: float
    look: float
    fine: float

    def __post_init__(self) -> None:
        if not all(0 < value < math.inf for value in (self.total, self.look, self.fine)):
            raise VariantError(f"chance values must be above 0 and finite: {self}")

    def of_strength(self, evidence: Mapping[str, float]) -> float:
        """The strength that chance gives a view with this evidence: of one level or of two."""
        return self.look if math.isnan(evidence["detail_ratio"]) else self.total


USUAL_CHANCES = Chances(32.0, 15.0, 48.0)
"""Chance values for a map on which none were measured: those of generated landscapes."""


@dataclass(frozen=True)
class RegisteredConfidence:
    """P(right) = P(the view fits) P(it fits nowhere near as well).

    Each is a logistic regression. The second has the last two `FEATURES`, the first has the others:
    a strong fit cannot outweigh ground that repeats. What each feature shows wrong:

    - `log_strength`: score over that of chance. Views that show nothing of the map.
    - `log_peak_ratio`: score over that of the strongest rival. Ground that exists more than once.
      Where the view was doubtful enough to be judged one level finer too, it is the mean with and
      without it: on blurred views the finer level alone is overconfident.
    - `log_look_ratio`: the same among all candidates, at a coarser level.
    - `log_detail_ratio`: score at the finest level over that at the coarser one. Chance matches
      lose more in detail.
    - `log_local_phase`: phase correlation over that a little aside, in standard deviations. Views
      that share shapes with the place, but not their detail.
    - `log_alone_phase`, `log_alone_gradients`: the same number, and gradients over those a little
      aside, in standard deviations. Rows, lattices, single roads.

    A share of chance stands in for a rival where none was found, so that a narrow search does not
    appear as certainty. Weights are never negative: more evidence never means less confidence.
    """

    biases: tuple[float, float]
    weights: tuple[float, ...]
    chances: Chances

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        found = self.of(features_of(evidence, self.chances))
        return min(found, CUT_SHORT) if evidence.get("cut_short") else found

    def of(self, features: NDArray[np.float64]) -> float:
        """The same, by features (7,)."""
        fits = self.biases[0] + float(np.dot(self.weights[:-ALONE], features[:-ALONE]))
        alone = self.biases[1] + float(np.dot(self.weights[-ALONE:], features[-ALONE:]))
        return probability(fits) * probability(alone)

    @classmethod
    def usual(cls, chances: Chances) -> "RegisteredConfidence":
        """With the usual weights, and a map's own scores of chance."""
        return cls(USUAL_BIASES, USUAL_WEIGHTS, chances)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {
            "biases": list(self.biases),
            "weights": dict(zip(FEATURES, self.weights, strict=True)),
            "chances": {name: getattr(self.chances, name) for name in CHANCES},
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "RegisteredConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit."""
        try:
            chances = Chances(**{name: float(plain["chances"][name]) for name in CHANCES})
            first, second = plain["biases"]
            biases = float(first), float(second)
            weights = tuple(float(plain["weights"][name]) for name in FEATURES)
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(
                f"confidence of registration must have two biases, weights of {FEATURES} and "
                f"chances of {CHANCES}, got {plain!r:.200}"
            ) from error
        if not all(math.isfinite(number) for number in (*biases, *weights)) or min(weights) < 0:
            raise VariantError(
                f"confidence of registration has a weight that is negative or not finite: {plain}"
            )
        return cls(biases, weights, chances)


def features_of(evidence: Mapping[str, float], chances: Chances) -> NDArray[np.float64]:
    """Features (7,) of the evidence of a registered view, see `RegisteredConfidence`."""
    strength, look = max(evidence["strength"], 1e-3), max(evidence["look"], 1e-3)
    detail, chance = evidence["detail_ratio"], chances.of_strength(evidence)
    if math.isnan(detail):
        detail = USUAL_DETAIL
    ratio = strength / max(evidence["rival"], STAND_IN * chance)
    fine, fine_rival = evidence["fine"], evidence["fine_rival"]
    if math.isfinite(fine + fine_rival):
        ratio = math.sqrt(ratio * max(fine, 1e-3) / max(fine_rival, STAND_IN * chances.fine))
    look_ratio = look / max(evidence["look_rival"], STAND_IN * chances.look)
    phase, gradients = (
        max(evidence[name], LEAST_DEVIATIONS) for name in ("local_phase", "local_gradients")
    )
    return np.log(
        [strength / chance, ratio, look_ratio, max(detail, 1e-3), phase, phase, gradients]
    )


def fit_registered(
    evidence: Sequence[Mapping[str, float]], right: NDArray[np.bool_], chances: Chances
) -> RegisteredConfidence:
    """The usual confidence with its first bias fitted to views (N) that came out right or not (N,)
    and drawn to the usual one."""
    from scipy.optimize import minimize_scalar  # not needed to fly

    usual = RegisteredConfidence.usual(chances)
    features = [features_of(each, chances) for each in evidence]

    def shifted(shift: float) -> RegisteredConfidence:
        return replace(usual, biases=(usual.biases[0] + shift, usual.biases[1]))

    def loss(shift: float) -> float:
        model = shifted(shift)
        said = np.clip([model.of(each) for each in features], LEAST, 1 - LEAST)
        return float(RIDGE * shift**2 - np.log(np.where(right, said, 1 - said)).mean())

    return shifted(float(minimize_scalar(loss, bounds=(-MAX_SHIFT, MAX_SHIFT)).x))


USUAL_CONFIDENCE = RegisteredConfidence.usual(USUAL_CHANCES)
"""For a map without views to learn from."""
