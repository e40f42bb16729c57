"""How likely a fix is right: a probability from scores, and acceptance by a threshold.

Weights of registration are those of real imagery of two dates (`python -m benchmarks.trust`),
scores of chance those of the map; weights of tiles are learnt when the map is built.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.records import Fix, NoFix

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


USUAL_CONFIDENCE = RegisteredConfidence.usual(USUAL_CHANCES)
"""For a map without views to learn from."""


TILE_FEATURES = ("score", "margin")
USUAL_SHIFT = 0.42
"""Standard deviation of the bias from map to map, under the weights of `USUAL_TILES`."""
LIMIT = 60.0
"""Largest logit: beyond, the probability is 0 or 1 to all digits of a float."""


@dataclass(frozen=True)
class LogisticConfidence:
    """P(right) = 1 / (1 + exp(-(bias + weights . evidence))).

    `weights` belong to the evidence named in `TILE_FEATURES`: the best score, and its lead over the
    best score elsewhere. Weights are never negative: more evidence never means less confidence.
    """

    bias: float
    weights: tuple[float, ...]

    def __call__(self, evidence: Mapping[str, float]) -> float:
        """Probability in 0..1 that the fix is right."""
        total = self.bias + sum(
            weight * evidence[name]
            for name, weight in zip(TILE_FEATURES, self.weights, strict=True)
        )
        return probability(total)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        return {"bias": self.bias, "weights": dict(zip(TILE_FEATURES, self.weights, strict=True))}

    @classmethod
    def from_plain(cls, plain: Any) -> "LogisticConfidence":
        """Inverse of `to_plain`; raises `VariantError` if it does not fit."""
        try:
            numbers = [
                float(plain["bias"]),
                *(float(plain["weights"][name]) for name in TILE_FEATURES),
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(
                f"confidence must have bias and weights of {TILE_FEATURES}"
            ) from error
        if not all(math.isfinite(number) for number in numbers) or min(numbers[1:]) < 0:
            raise VariantError(f"confidence has a weight that is negative or not finite: {plain}")
        return cls(numbers[0], tuple(numbers[1:]))


USUAL_TILES = LogisticConfidence(-3.42 - USUAL_SHIFT, (5.87, 12.08))
"""Of tiles of whitened gradients: fitted to the trials of 22 maps of nine scenes, and lower by one
standard deviation (docs/decisions/confidence.md)."""


def probability(logit: float) -> float:
    """The logistic function, cut off where it is 0 or 1 to all digits that matter."""
    return 1 / (1 + math.exp(-min(max(logit, -LIMIT), LIMIT)))


def logit(likely: float, least: float) -> float:
    """Logarithm of the odds of a probability that is taken as `least` to 1 - `least`."""
    inside = min(max(likely, least), 1 - least)
    return math.log(inside / (1 - inside))


CRITERIA = {
    "confidence": (0.01, 1.0),
    "peak_ratio": (1.0, 1000.0),
    "lowe_ratio": (1.0, 1000.0),
}
"""Thresholds that make sense, by criterion. The best of two scores is no less than the other."""


@dataclass(frozen=True)
class Acceptance:
    """Fixes whose `criterion` is below `threshold` are withheld.

    `confidence`: the calibrated probability; `peak_ratio`: best over its strongest rival;
    `lowe_ratio`: best over second best tile, the criterion of Di Piazza et al. 2024 (threshold
    1.13), which only tile search has.
    """

    criterion: str
    threshold: float

    @classmethod
    def parse(cls, text: str) -> "Acceptance":
        """From `name:threshold`, the value of `--accept`; raises `VariantError`."""
        name, _, value = text.partition(":")
        try:
            threshold = float(value)
        except ValueError:
            threshold = math.nan
        if name not in CRITERIA or not math.isfinite(threshold):
            raise VariantError(
                f"--accept must be one of {', '.join(CRITERIA)} with a threshold, such as "
                f"confidence:0.9 or lowe_ratio:1.13, got '{text}'"
            )
        least, most = CRITERIA[name]
        if not least <= threshold <= most:
            raise VariantError(
                f"--accept {name}: the threshold must be {least:g} to {most:g}, got {value}"
            )
        return cls(name, threshold)

    def __call__(self, outcome: Fix | NoFix) -> Fix | NoFix:
        """The outcome, or `NoFix` where the number is below the threshold or unknown."""
        if isinstance(outcome, NoFix) or self.accepts(outcome):
            return outcome
        value = self._value(outcome)
        value_text = "unknown" if math.isnan(value) else f"{value:.3g}"
        detail = f"{self.criterion} is {value_text}, at least {self.threshold:g} is required"
        return NoFix("low_confidence", detail, outcome.evidence)

    def accepts(self, outcome: Fix | NoFix) -> bool:
        """Whether there is a fix whose number is known and not below the threshold."""
        return isinstance(outcome, Fix) and self._value(outcome) >= self.threshold

    def _value(self, fix: Fix) -> float:
        if self.criterion == "confidence":
            return fix.confidence
        return fix.evidence.get(self.criterion, math.nan)


def within(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    radius_m: float,
    middle: NDArray[np.float64] | None = None,
) -> float:
    """Probability that a state lies within a radius of `middle` (2,), its own mean where None.

    Exact for a round Gaussian around the middle; a distance from it is treated as added variance.
    """
    variance = float(covariance[0, 0] + covariance[1, 1]) / 2
    away = 0.0 if middle is None else math.dist(mean[:2], middle)
    if away > radius_m + 3 * math.sqrt(variance):
        return 0.0
    return 1 - math.exp(-(radius_m**2) / (2 * variance + away**2 + 1e-9))
