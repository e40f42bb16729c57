"""Sheets as the catalogue of an atlas describes them, at two places."""

from dataclasses import replace

from orthonav.ground.atlas.catalog import AtlasRecipe, Sheet

RECIPE = AtlasRecipe(gsd_m=1.0)
PLACES = (46.6, 1.9), (46.6, 2.1)
HERE, EAST = (RECIPE.sheets.name_at(*place) for place in PLACES)


def described(sheet=HERE, **others):
    made = Sheet(
        id=sheet,
        bounds_deg=RECIPE.sheets.bounds_deg(sheet),
        gsd_m=1.0,
        tiles=12,
        area_km2=3.25,
        dates=("2020-06-14",),
        imagery=({"name": "BD ORTHO", "attribution": "IGN", "licence": "Etalab-2.0"},),
        request="request 1",
        made_by={"orthonav": "1.0"},
    )
    return replace(made, **others)
