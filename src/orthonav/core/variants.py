"""Choosing a variant by name: `canny:low=100,high=200`.

A frozen dataclass whose fields are its parameters, by a table of names; nothing is evaluated."""

import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from orthonav.core.errors import VariantError


@dataclass(frozen=True)
class Variant:
    """`module:Class`, whether it may fly, and the extra it needs."""

    path: str
    flies: bool = True
    extra: str | None = None


def within(default: Any, least: float, most: float = math.inf, *, above: bool = False) -> Any:
    """A field of `Checked` of at least `least`, or `above` it, and at most `most`."""
    expected = f"above {least:g}" if above else f"at least {least:g}"
    expected += f" and at most {most:.9g}" if most < math.inf else ""

    def fits(value: Any) -> bool:
        return bool((least < value if above else least <= value) and value <= most)

    return _field(default, fits, expected)


def choice(default: Any, *others: Any) -> Any:
    """A field of `Checked` with one of these values."""
    known = (default, *others)
    return _field(default, lambda value: value in known, f"one of {', '.join(map(str, known))}")


def _field(default: Any, fits: Callable[[Any], bool], expected: str) -> Any:
    return dataclasses.field(default=default, metadata={"fits": fits, "expected": expected})


class Checked:
    """Base of variants: raises `VariantError` for a field with a value that it may not have."""

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):  # type: ignore[arg-type]  # of those derived
            if "fits" in each.metadata:
                fits, expected = each.metadata["fits"], each.metadata["expected"]
                require_fits(each.name, getattr(self, each.name), fits, expected)


def require_fits(name: str, value: Any, fits: Callable[[Any], bool], expected: str) -> None:
    if not fits(value):
        raise VariantError(f"{name} must be {expected}, got {value}")


Table = Mapping[str, Variant]
Part = Callable[[str, Any, int], NDArray[Any]]
"""Gives a part of a map by name, type and number of dimensions."""


def make_variant(table: Table, text: str) -> Any:
    """`name` or `name:field=value,...`; raises `VariantError`."""
    name, _, rest = text.partition(":")
    if name not in table:
        raise VariantError(f"unknown variant '{name}'; known are: {', '.join(sorted(table))}")
    values: dict[str, Any] = {}
    for item in filter(None, rest.split(",")):
        key, separator, value = item.partition("=")
        if not separator:
            raise VariantError(f"expected field=value in '{text}', got '{item}'")
        values[key.strip()] = value.strip()
    return _construct(table, name, values)


def variant_from_recipe(table: Table, recipe: Any, *, flying: bool = False) -> Any:
    """The inverse of `variant_recipe`; raises `VariantError`.

    With `flying`, variants that may not fly are refused before anything of theirs is loaded."""
    if not isinstance(recipe, dict) or not isinstance(recipe.get("name"), str):
        raise VariantError(f"expected a variant with a name, got {recipe!r}")
    if recipe["name"] not in table:
        raise VariantError(f"unknown variant '{recipe['name']}'; this program is too old for it")
    if flying and not table[recipe["name"]].flies:
        raise VariantError(f"'{recipe['name']}' does not fly, it is for experiments only")
    fields = {key: value for key, value in recipe.items() if key != "name"}
    return _construct(table, recipe["name"], fields)


def variant_recipe(table: Table, variant: Any) -> dict[str, Any]:
    """Plain values for a manifest."""
    path = f"{type(variant).__module__}:{type(variant).__qualname__}"
    for name, entry in table.items():
        if entry.path == path:
            return {"name": name, **dataclasses.asdict(variant)}
    raise VariantError(f"{path} is not in the table of variants")


def _construct(table: Table, name: str, values: Mapping[str, Any]) -> Any:
    module, _, class_name = table[name].path.partition(":")
    cls = getattr(importlib.import_module(module), class_name)
    types = {field.name: field.type for field in dataclasses.fields(cls)}
    unknown = sorted(set(values) - set(types))
    if unknown:
        raise VariantError(
            f"'{name}' has no parameter {', '.join(unknown)}; it has: {', '.join(types) or 'none'}"
        )
    return cls(**{key: _converted(name, key, types[key], value) for key, value in values.items()})


def _converted(name: str, key: str, kind: Any, value: Any) -> Any:
    try:
        if kind is int and float(value) == int(float(value)):
            return int(float(value))
        if kind is float and math.isfinite(float(value)):
            return float(value)
        if kind is str and isinstance(value, str):
            return value
    except (TypeError, ValueError, OverflowError):
        pass
    raise VariantError(f"'{name}' parameter {key} must be {kind.__name__}, got {value!r}")
