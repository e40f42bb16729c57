"""Confidence of a registered view: a probability from how well it fits, here and elsewhere."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.logistic import fit_weights
from orthonav.errors import VariantError

FEATURES = ("log_strength", "log_peak_ratio", "log_look_ratio")
LIMIT = 60.0


@dataclass(frozen=True)
class RegisteredConfidence:
    """P(right) = 1 / (1 + exp(-(bias + weights . features))).

    Features are logarithms: of the strength over `chance` (that of the best place of a view that
    is not on the map), of the strength over the best elsewhere, and of the same comparison among
    all candidates at a coarser level. `chance` also stands in for a rival where none was looked
    at, so that a narrow search does not look like certainty. Weights are never negative: more
    evidence never means less confidence. `look_chance` is the chance value at the coarser level.
    """

    bias: float
    weights: tuple[float, ...]
    chance: float
    look_chance: float

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        total = self.bias + float(np.dot(self.weights, self.features(evidence)))
        return 1 / (1 + math.exp(-min(max(total, -LIMIT), LIMIT)))

    def features(self, evidence: Mapping[str, float]) -> NDArray[np.float64]:
        """Features (3,) of evidence with `strength`, `rival`, `look`, `look_rival`."""
        return features_of(evidence, self.chance, self.look_chance)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {
            "bias": self.bias,
            "weights": dict(zip(FEATURES, self.weights, strict=True)),
            "chance": self.chance,
            "look_chance": self.look_chance,
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "RegisteredConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit."""
        try:
            weights = tuple(float(plain["weights"][name]) for name in FEATURES)
            bias, chance, look = (float(plain[key]) for key in ("bias", "chance", "look_chance"))
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(
                f"confidence of registration must have bias, chance, look_chance and weights of "
                f"{FEATURES}"
            ) from error
        numbers = [bias, chance, look, *weights]
        if not all(math.isfinite(number) for number in numbers):
            raise VariantError(f"confidence of registration is not finite: {plain}")
        if min(weights) < 0 or min(chance, look) <= 0:
            raise VariantError(f"confidence of registration has impossible values: {plain}")
        return cls(bias, weights, chance, look)


def features_of(
    evidence: Mapping[str, float], chance: float, look_chance: float
) -> NDArray[np.float64]:
    """Features (3,) of evidence, as `RegisteredConfidence` describes them."""
    strength, look = max(evidence["strength"], 1e-3), max(evidence["look"], 1e-3)
    return np.log(
        [
            strength / chance,
            strength / max(evidence["rival"], chance),
            look / max(evidence["look_rival"], look_chance),
        ]
    )


def fit_registered(
    evidence: list[Mapping[str, float]],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    chance: float,
    look_chance: float,
) -> RegisteredConfidence:
    """The confidence that fits views (N) of which it is known whether they came out right."""
    features = np.stack([features_of(each, chance, look_chance) for each in evidence])
    bias, weights = fit_weights(features, right, sample_weight)
    return RegisteredConfidence(bias, weights, chance, look_chance)
