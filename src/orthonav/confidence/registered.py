"""Confidence of a registered view: a probability from its score and its rivals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.logistic import fit_weights, probability
from orthonav.errors import VariantError

FEATURES = ("log_strength", "log_peak_ratio", "log_look_ratio")
CHANCES = ("total", "look", "fine")
USUAL_BIAS, USUAL_WEIGHTS = -4.2, (3.0, 9.0, 1.5)
"""What separates right from wrong on generated landscapes, cautious enough to refuse views of other
places; a map's own are drawn towards them."""
RIDGE = 3e-2
"""Weight of the usual values, see docs/decisions/confidence.md."""
STAND_IN = 0.7
"""Share of the chance value that stands in for a rival where a narrow search found none."""


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


USUAL_CHANCES = Chances(32.0, 15.0, 48.0)
"""Chance values for a map on which none were measured: those of generated landscapes."""


@dataclass(frozen=True)
class RegisteredConfidence:
    """P(right) = 1 / (1 + exp(-(bias + weights . features))).

    Features are logarithms: of the strength over that of chance, of the strength over the best
    elsewhere, and of the same comparison among all candidates at a coarser level. Where the view
    was doubtful enough to be judged one level finer too, the second is the mean with and without
    it: on blurred views the finer level alone is overconfident. A share of chance stands in for a
    rival where none was found, so that a narrow search does not appear as certainty. Weights are
    never negative: more evidence never means less confidence.
    """

    bias: float
    weights: tuple[float, ...]
    chances: Chances

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        total = self.bias + float(np.dot(self.weights, features_of(evidence, self.chances)))
        return probability(total)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {
            "bias": self.bias,
            "weights": dict(zip(FEATURES, self.weights, strict=True)),
            "chances": {name: getattr(self.chances, name) for name in CHANCES},
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "RegisteredConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit."""
        try:
            weights = tuple(float(plain["weights"][name]) for name in FEATURES)
            chances = Chances(**{name: float(plain["chances"][name]) for name in CHANCES})
            bias = float(plain["bias"])
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
    """Features (3,) of the evidence of a registered view, see `RegisteredConfidence`."""
    strength, look = max(evidence["strength"], 1e-3), max(evidence["look"], 1e-3)
    ratio = strength / max(evidence["rival"], STAND_IN * chances.total)
    fine, fine_rival = evidence.get("fine", math.nan), evidence.get("fine_rival", math.nan)
    if math.isfinite(fine + fine_rival):
        ratio = math.sqrt(ratio * max(fine, 1e-3) / max(fine_rival, STAND_IN * chances.fine))
    look_ratio = look / max(evidence["look_rival"], STAND_IN * chances.look)
    return np.log(np.array([strength / chances.total, ratio, look_ratio], dtype=np.float64))


def fit_registered(
    evidence: Sequence[Mapping[str, float]],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    chances: Chances,
) -> RegisteredConfidence:
    """The confidence that fits views (N) of which it is known whether they came out right."""
    features = np.stack([features_of(each, chances) for each in evidence])
    bias, weights = fit_weights(features, right, sample_weight, RIDGE, (USUAL_BIAS, USUAL_WEIGHTS))
    return RegisteredConfidence(bias, weights, chances)


USUAL_CONFIDENCE = RegisteredConfidence(USUAL_BIAS, USUAL_WEIGHTS, USUAL_CHANCES)
"""For a map without views to learn from."""
