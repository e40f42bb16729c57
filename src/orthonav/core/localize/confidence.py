"""How likely a fix is right: a probability from scores, and acceptance by a threshold.

Weights of registration are from real imagery of two dates (`benchmarks.integrity`), chance
scores from the map; weights of tiles are learnt when the map is built."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.limits import DEFAULT_RISK
from orthonav.core.records import CONFIDENT, Fix, NoFix, ViewResult

FEATURES = (
    "log_strength",
    "log_peak_ratio",
    "log_look_ratio",
    "log_detail_ratio",
    "log_local_phase",
    "log_alone_phase",
    "log_alone_gradients",
)
NEARBY = 2  # the last features compare with the ground nearby: it fits nowhere near as well


@dataclass(frozen=True)
class Chances:
    """Scores of the best wrong place over the map: at the mid and the final level, at the mid one
    alone, and with one finer."""

    total: float
    mid: float
    fine: float

    def __post_init__(self) -> None:
        if not all(0 < value < math.inf for value in (self.total, self.mid, self.fine)):
            raise VariantError(f"chance values must be above 0 and finite: {self}")

    def to_plain(self) -> dict[str, float]:
        return {key: getattr(self, name) for name, key in CHANCES.items()}

    @classmethod
    def from_plain(cls, plain: Any) -> "Chances":
        return cls(**{name: float(plain[key]) for name, key in CHANCES.items()})

    def of_strength(self, scores: "Scores") -> float:
        """By chance, of one level or of two."""
        return self.mid if math.isnan(scores.detail_ratio) else self.total


CHANCES = {"total": "total", "mid": "look", "fine": "fine"}
"""Keys of maps by the names here."""


@dataclass(frozen=True)
class Scores:
    """How well a view fits its best place, and how far that stands out.

    - `strength`: at the mid and the final level, less the penalty of the prior. `mid_score`: at the
      mid level. `fine`: with one level finer, NaN: not compared there. `.._rival`: of the strongest
      rival, 0 for none.
    - `detail_ratio`: score at the final over that at the mid level, NaN where these are one.
    - `local_..`: over the ground around, see `orthonav.core.register.refine`.
    - `cut_short`: whether `--budget-ms` ended the search."""

    strength: float
    rival: float
    mid_score: float
    mid_rival: float
    fine: float
    fine_rival: float
    detail_ratio: float
    local_ratio: float
    local_gradients: float
    local_phase: float
    cut_short: bool = False

    @property
    def peak_ratio(self) -> float:
        return min(self.strength / max(self.rival, 1e-6), MAX_RATIO)  # in this order NaN stays

    @property
    def mid_ratio(self) -> float:
        return min(self.mid_score / max(self.mid_rival, 1e-6), MAX_RATIO)

    def evidence(self) -> dict[str, float]:
        """By the keys of `fixes.jsonl` (docs/reference/formats.md)."""
        named = {STORED.get(name, name): value for name, value in asdict(self).items()}
        ratios = {"peak_ratio": self.peak_ratio, "look_ratio": self.mid_ratio}
        cut_short = {"cut_short": 1.0} if named.pop("cut_short") else {}
        return named | ratios | cut_short

    @classmethod
    def of(cls, evidence: Mapping[str, float]) -> "Scores":
        """The inverse of `evidence`; `local_ratio` is no part of older records."""
        return cls(
            **{
                each.name: evidence.get(STORED.get(each.name, each.name), math.nan)
                for each in fields(cls)[:-1]
            },
            cut_short=bool(evidence.get("cut_short")),
        )


STORED = {"mid_score": "look", "mid_rival": "look_rival"}
"""Keys of `fixes.jsonl` that differ from the names here."""
MAX_RATIO = 10.0
DEFAULT_CHANCES = Chances(32.0, 15.0, 48.0)
"""Of generated landscapes, for maps on which none were measured."""


@dataclass(frozen=True)
class RegisteredConfidence:
    """P(right) = P(the view fits) P(it fits nowhere near as well).

    Each is a logistic regression, so that a strong fit cannot outweigh ground that repeats. What
    each feature shows wrong:

    - `log_strength`: score over chance. Views that show nothing of the map.
    - `log_peak_ratio`: score over that of the strongest rival: ground that repeats. In doubt, the
      mean with and without a finer level: on blurred views that one alone is overconfident.
    - `log_look_ratio`: the same among all candidates, at a coarser level.
    - `log_detail_ratio`: finest over coarser score. Chance matches lose more in detail.
    - `log_local_phase`: phase correlation over that a little aside, in standard deviations. Views
      with the place's shapes, but not its detail.
    - `log_alone_phase`, `log_alone_gradients`: the same at the finest level. Rows, lattices, single
      roads.

    Weights are never negative: more evidence never means less confidence."""

    biases: tuple[float, float]
    weights: tuple[float, ...]
    chances: Chances

    def __call__(self, scores: Scores) -> float:
        """Below `CONFIDENT` where `--budget-ms` ended the search before a place stood out."""
        found = self.of(features_of(scores, self.chances))
        return min(found, CONFIDENT - 0.01) if scores.cut_short else found

    def of(self, features: NDArray[np.float64]) -> float:
        fits = self.biases[0] + float(np.dot(self.weights[:-NEARBY], features[:-NEARBY]))
        unlike = self.biases[1] + float(np.dot(self.weights[-NEARBY:], features[-NEARBY:]))
        return probability(fits) * probability(unlike)

    @classmethod
    def usual(cls, chances: Chances) -> "RegisteredConfidence":
        """Fitted to 1,734 views (docs/decisions/confidence.md)."""
        return cls((-6.68, -8.0), (2.35, 4.29, 5.87, 2.7, 2.28, 4.05, 3.03), chances)

    def to_plain(self) -> dict[str, Any]:
        return {
            "biases": list(self.biases),
            "weights": dict(zip(FEATURES, self.weights, strict=True)),
            "chances": self.chances.to_plain(),
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "RegisteredConfidence":
        try:
            chances = Chances.from_plain(plain["chances"])
            first, second = plain["biases"]
            biases = float(first), float(second)
            weights = tuple(float(plain["weights"][name]) for name in FEATURES)
        except (KeyError, TypeError, ValueError) as error:
            raise VariantError(
                f"confidence of registration must have two biases, weights of {FEATURES} and "
                f"chances of {tuple(CHANCES.values())}, got {plain!r:.200}"
            ) from error
        if not all(math.isfinite(number) for number in (*biases, *weights)) or min(weights) < 0:
            raise VariantError(
                f"confidence of registration has a weight that is negative or not finite: {plain}"
            )
        return cls(biases, weights, chances)


def features_of(scores: Scores, chances: Chances) -> NDArray[np.float64]:
    """Features (7,) of `RegisteredConfidence`."""
    strength, mid_score = max(scores.strength, 1e-3), max(scores.mid_score, 1e-3)
    detail, chance = scores.detail_ratio, chances.of_strength(scores)
    if math.isnan(detail):
        detail = 1.4  # usual; the view is too small for a final level of its own
    stand_in = 0.7  # of the chance value: stands in for a rival where none was found
    ratio = strength / max(scores.rival, stand_in * chance)
    fine, fine_rival = scores.fine, scores.fine_rival
    if math.isfinite(fine + fine_rival):
        ratio = math.sqrt(ratio * max(fine, 1e-3) / max(fine_rival, stand_in * chances.fine))
    mid_ratio = mid_score / max(scores.mid_rival, stand_in * chances.mid)
    # Less than one standard deviation above the ground nearby does not count.
    phase, gradients = (max(each, 1.0) for each in (scores.local_phase, scores.local_gradients))
    return np.log([strength / chance, ratio, mid_ratio, max(detail, 1e-3), phase, phase, gradients])


DEFAULT_CONFIDENCE = RegisteredConfidence.usual(DEFAULT_CHANCES)
TILE_FEATURES = ("score", "margin")
DEFAULT_SHIFT = 0.42  # of the bias from map to map, under `DEFAULT_TILE_CONFIDENCE`


@dataclass(frozen=True)
class LogisticConfidence:
    """P(right) = 1 / (1 + exp(-(bias + weights . evidence))), of `TILE_FEATURES`; weights >= 0."""

    bias: float
    weights: tuple[float, ...]

    def __call__(self, evidence: Mapping[str, float]) -> float:
        total = self.bias + sum(
            weight * evidence[name]
            for name, weight in zip(TILE_FEATURES, self.weights, strict=True)
        )
        return probability(total)

    def to_plain(self) -> dict[str, Any]:
        return {"bias": self.bias, "weights": dict(zip(TILE_FEATURES, self.weights, strict=True))}

    @classmethod
    def from_plain(cls, plain: Any) -> "LogisticConfidence":
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


DEFAULT_TILE_CONFIDENCE = LogisticConfidence(-3.42 - DEFAULT_SHIFT, (5.87, 12.08))
"""Fitted to 22 maps of nine scenes, one standard deviation lower (docs/decisions/confidence.md)."""


def probability(logit: float) -> float:
    # Beyond 60 it is 0 or 1 in floating point.
    return 1 / (1 + math.exp(-min(max(logit, -60.0), 60.0)))


def logit(likely: float, least: float) -> float:
    """Log odds of a probability limited to `least` .. 1 - `least`."""
    inside = min(max(likely, least), 1 - least)
    return math.log(inside / (1 - inside))


CRITERIA = {"confidence": (0.01, 1.0), "peak_ratio": (1.0, 1000.0), "lowe_ratio": (1.0, 1000.0)}
"""Sensible thresholds: best over second best is at least 1."""
ALERT_LIMIT = "alert_limit"


@dataclass(frozen=True)
class Acceptance:
    """Accepts fixes whose `criterion` is at least `threshold`, or, for `ALERT_LIMIT`, those whose
    protection level at `risk` is at most that many metres.

    `lowe_ratio`: best over second best tile (Di Piazza et al. 2024: 1.13), of tile search only.
    `risk`: also of the protection levels that results state, whatever the criterion."""

    criterion: str
    threshold: float
    risk: float = DEFAULT_RISK

    @classmethod
    def parse(cls, text: str, risk: float = DEFAULT_RISK) -> "Acceptance":
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
        return cls(name, threshold, risk)

    @property
    def alert_limit_m(self) -> float:
        """Infinite where another criterion decides."""
        return self.threshold if self.criterion == ALERT_LIMIT else math.inf

    def text(self) -> str:
        if self.criterion == ALERT_LIMIT:
            return f"a protection level of at most {self.threshold:g} m at a risk of {self.risk:g}"
        return f"{self.criterion.replace('_', ' ')} {self.threshold:g} or more"

    def accepts(self, outcome: Fix | NoFix) -> bool:
        if not isinstance(outcome, Fix):
            return False
        if self.criterion == ALERT_LIMIT:
            return self._value(outcome) <= self.threshold
        return self._value(outcome) >= self.threshold

    def judged(self, result: ViewResult) -> ViewResult:
        return replace(result, accepted=self.accepts(result.outcome), risk=self.risk)

    def knows(self, outcome: Fix | NoFix) -> bool:
        """Whether a fix states the number that is compared."""
        return isinstance(outcome, Fix) and not math.isnan(self._value(outcome))

    def _value(self, fix: Fix) -> float:
        if self.criterion == ALERT_LIMIT:
            return fix.protection_level_m(self.risk)
        if self.criterion == "confidence":
            return fix.confidence
        return fix.evidence.get(self.criterion, math.nan)


def within(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    radius_m: float,
    middle: NDArray[np.float64] | None = None,
) -> float:
    """Probability of being within a radius of `middle` (2,), None: the mean; exact for a round
    Gaussian, else a distance from it counts as variance."""
    variance = float(covariance[0, 0] + covariance[1, 1]) / 2
    away = 0.0 if middle is None else math.dist(mean[:2], middle)
    if away > radius_m + 3 * math.sqrt(variance):
        return 0.0
    return 1 - math.exp(-(radius_m**2) / (2 * variance + away**2 + 1e-9))
