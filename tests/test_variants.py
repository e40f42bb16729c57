"""Choosing variants by name, and writing down which was chosen."""

import json
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.errors import VariantError
from orthonav.core.variants import Variant, make_variant, variant_from_recipe, variant_recipe


@dataclass(frozen=True)
class Knobs:
    share: float = 0.5
    count: int = 3
    kind: str = "plain"

    def __post_init__(self) -> None:
        if self.count < 0:
            raise VariantError(f"count must not be negative, got {self.count}")


@dataclass(frozen=True)
class Bare:
    pass


TABLE = {"knobs": Variant(f"{__name__}:Knobs"), "bare": Variant(f"{__name__}:Bare", flies=False)}


@pytest.mark.parametrize(
    "text, expected",
    [
        ("knobs", Knobs()),
        ("knobs:", Knobs()),
        ("knobs:count=7", Knobs(count=7)),
        ("knobs:share=1e-3,count=-0,kind=odd", Knobs(0.001, 0, "odd")),
        ("knobs: share = 2 , count = 4.0", Knobs(2.0, 4)),
        ("bare", Bare()),
    ],
)
def test_text_makes_the_variant(text, expected):
    made = make_variant(TABLE, text)
    assert made == expected
    assert [*map(type, vars(made).values())] == [*map(type, vars(expected).values())]


@pytest.mark.parametrize(
    "text, message",
    [
        ("none", "unknown variant 'none'; known are: bare, knobs"),
        ("", "unknown variant ''"),
        ("Knobs", "unknown variant"),
        ("knobs:size=3", "no parameter size; it has: share, count, kind"),
        ("bare:size=3", "it has: none"),
        ("knobs:count", "expected field=value in 'knobs:count', got 'count'"),
        ("knobs:count=many", "count must be int, got 'many'"),
        ("knobs:count=1.5", "count must be int"),
        ("knobs:count=nan", "count must be int"),
        ("knobs:count=inf", "count must be int"),
        ("knobs:count=", "count must be int"),
        ("knobs:share=nan", "share must be float"),
        ("knobs:share=-inf", "share must be float"),
        ("knobs:share=__import__('os')", "share must be float"),
        ("knobs:count=-1", "count must not be negative"),
        ("knobs:__class__=1", "no parameter __class__"),
    ],
)
def test_what_does_not_fit_is_named(text, message):
    with pytest.raises(VariantError, match=message.replace("(", r"\(").replace(")", r"\)")):
        make_variant(TABLE, text)


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.builds(Knobs, finite, st.integers(0, 2**53), st.text()) | st.just(Bare()))
def test_a_recipe_survives_json(variant):
    recipe = json.loads(json.dumps(variant_recipe(TABLE, variant)))
    assert variant_from_recipe(TABLE, recipe) == variant


@pytest.mark.parametrize(
    "recipe",
    [
        None,
        [],
        "knobs",
        {},
        {"name": 3},
        {"name": "newer"},
        {"name": "knobs", "size": 3},
        {"name": "knobs", "share": "wide"},
        {"name": "knobs", "share": None},
        {"name": "knobs", "count": [1]},
        {"name": "knobs", "kind": 3},
        {"name": "knobs", "count": -1},
        {"name": "knobs", "count": 10**400},
    ],
)
def test_a_recipe_that_does_not_fit_is_refused(recipe):
    with pytest.raises(VariantError):
        variant_from_recipe(TABLE, recipe)
