"""Validated numbers and texts of route files."""

import json
import math
from typing import Any

from orthonav.core.errors import RouteError


def number(value: Any, what: str) -> float:
    """A finite JSON number. Raises `RouteError` for anything else, as `"12"` or true."""
    if type(value) not in (int, float) or not math.isfinite(value):
        raise RouteError(f"{what} must be a number, got {value!r:.80}")
    return float(value)


def number_or_none(value: Any, what: str) -> float | None:
    """As `number`; None for null, NaN and missing values."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return number(value, what)


def parsed(text: str, what: str) -> float:
    """The finite number in a text. Raises `RouteError`, also for NaN and infinity."""
    try:
        value = float(text)
    except ValueError as error:
        raise RouteError(f"{what} must be a number, got {text!r:.80}") from error
    if not math.isfinite(value):
        raise RouteError(f"{what} must be a number, got {text!r:.80}")
    return value


def numbers_in(text: str) -> list[float]:
    """The numbers of a text with commas, such as longitude, latitude, height; none where it holds
    something else."""
    try:
        return [float(each) for each in text.split(",")]
    except ValueError:
        return []


def decoded(data: bytes) -> str:
    """Text of UTF-8 bytes, with or without a byte order mark. Raises `RouteError`."""
    if not data.strip():
        raise RouteError("route file is empty")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RouteError(
            "route file is not UTF-8 text; check that its suffix matches its format"
        ) from (error)


def json_object(data: bytes) -> dict[str, Any]:
    """The object of a JSON document. Raises `RouteError`."""
    try:
        plain = json.loads(decoded(data))
    except (json.JSONDecodeError, RecursionError) as error:
        raise RouteError(f"route cannot be read as JSON ({error})") from error
    if not isinstance(plain, dict):
        raise RouteError(f"route must be a JSON object, got {type(plain).__name__}")
    return plain
