"""Numbers as text; an undefined one is a dash."""

import math


def percent_text(value: float) -> str:
    """A share as `12.3 %`, and `-` where it is not defined."""
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"


def metres_text(value: float) -> str:
    """A length, in kilometres from 10 km on, and `-` where it is not defined.

    Below 100 m it has one decimal unless that is 0. `metres` in `format.js` is the same for pages.
    """
    if not math.isfinite(value):
        return "-"
    if abs(value) >= 10_000:
        return f"{value / 1000:.1f} km"
    text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}".removesuffix(".0")
    return f"{text} m"


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
