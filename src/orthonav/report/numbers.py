"""Numbers as reports write them; what is not defined is a dash."""

import math


def percent_text(value: float) -> str:
    """A share as `12.3 %`, and `-` where it is not defined."""
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"


def plain_text(value: float) -> str:
    """A number without unit, with three decimals, and `-` where it is not defined."""
    return f"{value:.3f}" if math.isfinite(value) else "-"


def measure_text(value: float, unit: str = "") -> str:
    """A length or time with as many decimals as say something, and `-` where it is not defined.

    `unit` follows as it is, a space before it included.
    """
    if not math.isfinite(value):
        return "-"
    return (f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}") + unit
