"""The recipe that all sheets of an atlas share."""

from dataclasses import asdict, dataclass, fields
from typing import Any, cast

from orthonav.core.errors import AtlasError
from orthonav.ground.atlas.item import reason
from orthonav.ground.planning.world import WorldSheets

FORMAT = "orthonav-atlas"
SCHEMA = 1


def _require_possible(recipe: "CoarseRecipe | AtlasRecipe") -> None:
    """Raise `AtlasError` where a value has another type than its field, or is impossible."""
    for each in fields(recipe):
        value, kind = getattr(recipe, each.name), cast(type, each.type)
        if kind in (int, float):
            kinds = int if kind is int else (int, float)
            right = isinstance(value, kinds) and not isinstance(value, bool) and 0 <= value < 1e9
        else:
            right = isinstance(value, kind)
        if not right:
            raise AtlasError(f"{each.name} is {value!r:.40}")
    if not (recipe.gsd_m > 0 and recipe.tile_px > 0 and recipe.overlap < 1):
        raise AtlasError(
            f"gsd_m {recipe.gsd_m}, tile_px {recipe.tile_px}, overlap {recipe.overlap}"
        )


@dataclass(frozen=True)
class CoarseRecipe:
    """The coarse tiles in which a view is searched in the whole atlas: wide, at low resolution.

    `gsd_m`: metres per pixel, above 0. `tile_px`: width of a tile. `overlap`: share that
    neighbouring tiles have in common, 0 to below 1; below 0.875 fewer views are found
    (docs/decisions, the atlas). Raises `AtlasError` for impossible values.
    """

    gsd_m: float = 8.0
    tile_px: int = 128
    overlap: float = 0.875

    def __post_init__(self) -> None:
        _require_possible(self)

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
    Raises `AtlasError` and `AreaError` for impossible values.
    """

    gsd_m: float
    tile_px: int = 256
    overlap: float = 0.875
    method: str = "gradient"
    edges: str | None = None
    seed: int = 0
    registration: bool = True
    calibration_views: int = 24
    sheet_km: float = 10.0
    coarse: CoarseRecipe | None = CoarseRecipe()

    def __post_init__(self) -> None:
        _require_possible(self)
        WorldSheets(self.sheet_km * 1000)  # refuses impossible widths

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
            return cls(**values, coarse=None if coarse is None else CoarseRecipe(**coarse))
        except (KeyError, TypeError, ValueError) as error:
            raise AtlasError(f"recipe of the atlas cannot be read ({reason(error)})") from error

    def differences(self, other: "AtlasRecipe") -> list[str]:
        """The fields that differ, each as `name: this, not that`."""
        mine, theirs = self.to_plain(), other.to_plain()
        return [
            f"{name}: {mine[name]}, not {theirs[name]}"
            for name in mine
            if mine[name] != theirs[name]
        ]
