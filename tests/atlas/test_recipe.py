"""An untrusted recipe is valid, or an error with the reason."""

import pytest

from orthonav.core.errors import AtlasError
from orthonav.ground.atlas.catalog import AtlasRecipe, CoarseRecipe

RECIPE = AtlasRecipe(gsd_m=1.0)


def test_a_recipe_is_read_back():
    for recipe in (RECIPE, AtlasRecipe(2.5, coarse=None), AtlasRecipe(8, coarse=CoarseRecipe(4.0))):
        assert AtlasRecipe.from_plain(recipe.to_plain()) == recipe


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gsd_m", "abc"),
        ("gsd_m", 0.0),
        ("gsd_m", float("nan")),
        ("tile_px", -3),
        ("tile_px", 2.5),
        ("tile_px", True),
        ("overlap", 1.0),
        ("sheet_km", 1e6),
        ("method", 7),
        ("registration", "yes"),
        ("coarse", {"width": 3}),
        ("coarse", {"gsd_m": -8.0, "tile_px": 128, "overlap": 0.5}),
        ("coarse", 5),
    ],
    ids=str,
)
def test_impossible_values_are_refused(name, value):
    with pytest.raises(AtlasError, match="recipe"):
        AtlasRecipe.from_plain({**RECIPE.to_plain(), name: value})
