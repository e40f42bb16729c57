"""Numbers as text; an undefined one is a dash."""

import math


def percent_text(value: float) -> str:
    """A share as `12.3 %`, and `-` where it is not defined."""
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"


def plain_text(value: float) -> str:
    """A number without unit, with three decimals, and `-` where it is not defined."""
    return f"{value:.3f}" if math.isfinite(value) else "-"


def measure_text(value: float, unit: str = "") -> str:
    """A length or time with its significant decimals, and `-` where it is not defined.

    `unit` is appended, so it begins with a space.
    """
    if not math.isfinite(value):
        return "-"
    return (f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}") + unit
