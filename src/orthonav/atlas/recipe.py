"""The recipe that all sheets of an atlas share."""

from dataclasses import asdict, dataclass, fields
from typing import Any

from orthonav.errors import AtlasError
from orthonav.geo.world import WorldSheets

FORMAT = "orthonav-atlas"
SCHEMA = 1


@dataclass(frozen=True)
class CoarseRecipe:
    """The coarse tiles in which a view is searched in the whole atlas: wide, at low resolution.

    `gsd_m`: metres per pixel, above 0. `tile_px`: width of a tile. `overlap`: share that
    neighbouring tiles have in common, 0 to below 1; below 0.875 fewer views are found
    (docs/decisions, the atlas).
    """

    gsd_m: float = 8.0
    tile_px: int = 128
    overlap: float = 0.875

    @property
    def tile_m(self) -> float:
        """Width of a tile in metres."""
        return self.gsd_m * self.tile_px


@dataclass(frozen=True)
class AtlasRecipe:
    """How every sheet is made; fields and defaults not listed here are those of `BuildRequest`.

    `gsd_m`: metres per pixel.
    `sheet_km`: greatest width of a sheet.
    `coarse`: recipe of the coarse tiles; None leaves them out, and views then need a prior.
    """

    gsd_m: float
    tile_px: int = 256
    overlap: float = 0.875
    method: str = "gradient"
    edges: str | None = None
    seed: int = 0
    registration: bool = True
    calibration_views: int = 48
    sheet_km: float = 10.0
    coarse: CoarseRecipe | None = CoarseRecipe()

    @property
    def sheets(self) -> WorldSheets:
        """The sheets of the world at this size."""
        return WorldSheets(self.sheet_km * 1000)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for the catalogue."""
        return asdict(self)

    @classmethod
    def from_plain(cls, plain: Any) -> "AtlasRecipe":
        """Inverse of `to_plain`; raises `AtlasError` for unknown fields and impossible values."""
        try:
            values = {each.name: plain[each.name] for each in fields(cls)}
            coarse = values.pop("coarse")
            recipe = cls(**values, coarse=None if coarse is None else CoarseRecipe(**coarse))
            _require_plain(recipe)
            WorldSheets(recipe.sheet_km * 1000)
        except (KeyError, TypeError, ValueError) as error:
            raise AtlasError(f"recipe of the atlas cannot be read ({error})") from error
        return recipe

    def differences(self, other: "AtlasRecipe") -> list[str]:
        """The fields that differ, each as `name: this, not that`."""
        mine, theirs = self.to_plain(), other.to_plain()
        return [
            f"{name}: {mine[name]}, not {theirs[name]}"
            for name in mine
            if mine[name] != theirs[name]
        ]


_WHOLE = ("tile_px", "seed", "calibration_views")
_FRACTIONS = ("gsd_m", "overlap", "sheet_km")


def _require_plain(recipe: AtlasRecipe) -> None:
    """Raise `ValueError` where a value has another type, or is impossible."""
    parts: list[tuple[Any, tuple[str, ...], tuple[str, ...]]] = [(recipe, _WHOLE, _FRACTIONS)]
    if recipe.coarse is not None:
        parts.append((recipe.coarse, ("tile_px",), ("gsd_m", "overlap")))
    for part, whole, fractions in parts:
        for name in (*whole, *fractions):
            value = getattr(part, name)
            kinds = int if name in whole else (int, float)
            if isinstance(value, bool) or not isinstance(value, kinds) or not 0 <= value < 1e9:
                raise ValueError(f"{name} is {value!r:.40}")
        if not (part.gsd_m > 0 and part.tile_px > 0 and part.overlap < 1):
            raise ValueError(f"gsd_m {part.gsd_m}, tile_px {part.tile_px}, overlap {part.overlap}")
    if not isinstance(recipe.method, str) or not isinstance(recipe.edges, str | None):
        raise ValueError(f"method {recipe.method!r:.40}, edges {recipe.edges!r:.40}")
    if not isinstance(recipe.registration, bool):
        raise ValueError(f"registration is {recipe.registration!r:.40}")
