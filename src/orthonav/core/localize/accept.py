"""Acceptance of fixes: a threshold on one number of their evidence."""

import math
from dataclasses import dataclass

from orthonav.core.errors import VariantError
from orthonav.core.records import Fix, NoFix

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
