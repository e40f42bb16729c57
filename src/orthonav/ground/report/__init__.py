"""What the pages of all commands share: here numbers and records as text and as values for JSON (an
undefined number is a dash, or None); beside it pages, drawings and imagery.

Importing this imports neither matplotlib nor Jinja2.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np

BY_UNIT = -1
"""Decimals that the last word of a field's name asks for: a centimetre, say."""


def to_plain(value: Any, digits: int | None = None) -> Any:
    """`value` for strict JSON: records become dictionaries, arrays lists, NaN and infinity None.

    Numbers are rounded to `digits` decimals (`BY_UNIT`: by the names of their fields; None: not).
    """
    if isinstance(value, np.ndarray | np.generic):
        return to_plain(value.tolist(), digits)
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {name: to_plain(each, _digits(name, digits)) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(each, digits) for each in value]
    if isinstance(value, Enum):
        return value.value
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def _digits(name: str, digits: int | None) -> int | None:
    if digits != BY_UNIT:
        return digits
    by_unit = {"m": 2, "s": 2, "deg": 7, "km2": 4}
    return by_unit.get(name.rpartition("_")[2], 3)


def percent_text(value: float) -> str:
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"


def probability_text(value: float) -> str:
    """A probability in whole percent; 100 % only if it really is. As `percent` in `format.js`."""
    if not math.isfinite(value):
        return "-"
    percent = round(100 * value)
    return f"{99 if percent == 100 and value < 0.9995 else percent} %"


def metres_text(value: float) -> str:
    """A length, in kilometres from 10 km on; below 100 m with one decimal unless that is 0.

    `metres` in `format.js` is the same for pages.
    """
    if not math.isfinite(value):
        return "-"
    if abs(value) >= 10_000:
        return f"{value / 1000:.1f} km"
    text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}".removesuffix(".0")
    return f"{text} m"


def seconds_text(value: float) -> str:
    """A time in seconds, from two minutes on as `M:SS min`, from an hour on as `H:MM h`."""
    whole = round(value)
    if abs(whole) < 120:
        return f"{whole} s"
    if abs(whole) < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole // 60 % 60:02d} h"


def plain_text(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def measure_text(value: float, unit: str = "") -> str:
    """A length or time with its significant decimals; `unit` begins with a space."""
    if not math.isfinite(value):
        return "-"
    return (f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}") + unit


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines of a terminal: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            text.rjust(width) if i else text.ljust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
