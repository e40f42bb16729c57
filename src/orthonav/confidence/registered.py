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

from orthonav.confidence.logistic import probability
from orthonav.errors import VariantError

FEATURES = (
    "log_strength",
    "log_peak_ratio",
    "log_look_ratio",
    "log_local_ratio",
    "blocks_t",
    "log_detail_ratio",
)
OLD_FEATURES = {"log_strength", "log_peak_ratio", "log_look_ratio"}
"""Features of maps up to version 0.1."""
CHANCES = ("total", "look", "fine")
USUAL_BIAS, USUAL_WEIGHTS = -10.75, (2.83, 2.99, 3.73, 5.24, 1.11, 3.89)
"""What separates right from wrong: `python -m benchmarks.trust --fit` prints these numbers, and how
they judge scenes that they were not fitted to."""
RIDGE = 3e-2
"""Weight of the usual bias where views of another date of the map's area are fitted."""
MAX_SHIFT = 5.0
"""Largest change of the bias by them."""
STAND_IN = 0.7
"""Share of the chance value that stands in for a rival where a narrow search found none."""
LEAST_LOCAL = 0.5
"""Least ratio to the ground nearby that makes a difference."""
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
    """P(right) = 1 / (1 + exp(-(bias + weights . features))).

    Features, with what each shows wrong:

    - `log_strength`: score over that of chance. Views that show nothing of the map.
    - `log_peak_ratio`: score over that of the strongest rival. Ground that exists more than once.
      Where the view was doubtful enough to be judged one level finer too, it is the mean with and
      without it: on blurred views the finer level alone is overconfident.
    - `log_look_ratio`: the same among all candidates, at a coarser level.
    - `log_local_ratio`: correlation over the best one a little aside. Rows, lattices, single roads.
    - `blocks_t`: agreement of the blocks of the view. Views that one strong line places.
    - `log_detail_ratio`: score at the finest level over that at the coarser one. Chance matches
      lose more in detail.

    A share of chance stands in for a rival where none was found, so that a narrow search does not
    appear as certainty. Weights are never negative: more evidence never means less confidence.
    """

    bias: float
    weights: tuple[float, ...]
    chances: Chances

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        total = self.bias + float(np.dot(self.weights, features_of(evidence, self.chances)))
        return probability(total)

    @classmethod
    def usual(cls, chances: Chances) -> "RegisteredConfidence":
        """With the usual weights, and a map's own scores of chance."""
        return cls(USUAL_BIAS, USUAL_WEIGHTS, chances)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {
            "bias": self.bias,
            "weights": dict(zip(FEATURES, self.weights, strict=True)),
            "chances": {name: getattr(self.chances, name) for name in CHANCES},
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "RegisteredConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit.

        Maps built before all of `FEATURES` existed have the usual weights, with their own scores
        of chance.
        """
        try:
            stored, bias = plain["weights"], float(plain["bias"])
            if set(stored) == OLD_FEATURES:
                stored, bias = dict(zip(FEATURES, USUAL_WEIGHTS, strict=True)), USUAL_BIAS
            weights = tuple(float(stored[name]) for name in FEATURES)
            chances = Chances(**{name: float(plain["chances"][name]) for name in CHANCES})
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(
                f"confidence of registration must have a bias, weights of {FEATURES} and chances "
                f"of {CHANCES}, got {plain!r:.200}"
            ) from error
        if not all(math.isfinite(number) for number in (bias, *weights)) or min(weights) < 0:
            raise VariantError(
                f"confidence of registration has a weight that is negative or not finite: {plain}"
            )
        return cls(bias, weights, chances)


def features_of(evidence: Mapping[str, float], chances: Chances) -> NDArray[np.float64]:
    """Features (6,) of the evidence of a registered view, see `RegisteredConfidence`."""
    strength, look = max(evidence["strength"], 1e-3), max(evidence["look"], 1e-3)
    detail, chance = evidence["detail_ratio"], chances.of_strength(evidence)
    if math.isnan(detail):
        detail = USUAL_DETAIL
    ratio = strength / max(evidence["rival"], STAND_IN * chance)
    fine, fine_rival = evidence["fine"], evidence["fine_rival"]
    if math.isfinite(fine + fine_rival):
        ratio = math.sqrt(ratio * max(fine, 1e-3) / max(fine_rival, STAND_IN * chances.fine))
    look_ratio = look / max(evidence["look_rival"], STAND_IN * chances.look)
    local = max(evidence["local_ratio"], LEAST_LOCAL)
    logs = np.log(np.array([strength / chance, ratio, look_ratio, local], dtype=np.float64))
    return np.array([*logs, evidence["blocks_t"], math.log(max(detail, 1e-3))])


def fit_registered(
    evidence: Sequence[Mapping[str, float]], right: NDArray[np.bool_], chances: Chances
) -> RegisteredConfidence:
    """The usual confidence with the bias that fits views (N) that came out right or not (N,)."""
    from scipy.optimize import minimize_scalar  # not needed to fly

    usual = RegisteredConfidence.usual(chances)
    features = np.stack([features_of(each, chances) for each in evidence])
    logits, sign = usual.bias + features @ np.array(usual.weights), np.where(right, 1.0, -1.0)

    def loss(shift: float) -> float:
        return float(np.logaddexp(0, -sign * (logits + shift)).mean() + RIDGE * shift**2)

    shift = float(minimize_scalar(loss, bounds=(-MAX_SHIFT, MAX_SHIFT)).x)
    return replace(usual, bias=usual.bias + shift)


USUAL_CONFIDENCE = RegisteredConfidence.usual(USUAL_CHANCES)
"""For a map without views to learn from."""
