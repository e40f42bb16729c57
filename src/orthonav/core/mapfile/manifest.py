"""The manifest of a map (`docs/map-format.md`). Maps are untrusted: every value is checked."""

import hashlib
import json
import math
from dataclasses import dataclass, field, fields
from typing import Any

from orthonav.core.errors import AreaError, MapFileError, MapVersionError
from orthonav.core.geo.frames import MAX_SHEET_M, LocalFrame
from orthonav.core.geo.grid import MAX_TILE_PX, TileGrid
from orthonav.core.geo.ground import HIGHEST_M, LOWEST_M, RELIEF_SLOPES

FORMAT = "orthonav-map"
SCHEMA = 1
MAX_LEVELS = 10
MAX_CODE = 65_534  # of heights above the lowest one of a layer
MAX_NAME = 200
UNKNOWN_DATUM = "unknown"


def _within(least: float, most: float) -> dict[str, tuple[float, float]]:
    """For the metadata of a field: its least and greatest value."""
    return {"range": (least, most)}


def _are_within(info: Any) -> bool:
    """Whether all fields of a record are within their ranges, or None."""
    ranged = [each for each in fields(info) if "range" in each.metadata]
    values = [(getattr(info, each.name), *each.metadata["range"]) for each in ranged]
    return all(value is None or least <= value <= most for value, least, most in values)


def clamped(record: type, name: str, value: float) -> float:
    """The nearest value that a field of a record may have."""
    (least, most) = next(each.metadata["range"] for each in fields(record) if each.name == name)
    return float(min(max(value, least), most))


@dataclass(frozen=True)
class GreyInfo:
    """A grey pyramid in square chunks."""

    chunk_px: int = field(metadata=_within(16, 1024))  # even
    levels: int = field(metadata=_within(1, MAX_LEVELS))
    quality: int = field(metadata=_within(1, 100))  # of JPEG; less for noise
    valid_px: int  # pixels of the finest level with imagery

    def to_plain(self) -> dict[str, Any]:
        return {"codec": "jpeg", **vars(self)}

    @classmethod
    def from_plain(cls, plain: Any, grid: TileGrid) -> "GreyInfo":
        info = cls(**_fields(cls, plain))
        sane = (
            _get(plain, "codec", str) == "jpeg"
            and _are_within(info)
            and info.chunk_px % 2 == 0
            # The coarsest level is read as a whole: ten levels of the largest sheet at 5 cm.
            and max(grid.height_px, grid.width_px) <= 8192 << (info.levels - 1)
            and 0 <= info.valid_px <= grid.height_px * grid.width_px
        )
        if not sane:
            raise MapFileError(f"map has an impossible registration layer: {plain!r:.200}")
        return info


@dataclass(frozen=True)
class TerrainInfo:
    """Heights at samples in the sheet's plane: of the ground above mean sea level, or of a surface
    above that ground. Heights over `UNKNOWN_DATUM` can only be compared with each other."""

    west_m: float = field(metadata=_within(-4 * MAX_SHEET_M, 4 * MAX_SHEET_M))
    north_m: float = field(metadata=_within(-4 * MAX_SHEET_M, 4 * MAX_SHEET_M))
    """Outer north-west corner, half a posting from sample (0, 0)."""
    posting_m: float = field(metadata=_within(0.25, 1000.0))
    rows: int
    cols: int
    chunk_px: int = field(metadata=_within(16, 1024))  # samples along a side of a chunk
    low_m: float = field(metadata=_within(LOWEST_M, HIGHEST_M))  # least height ..
    high_m: float = field(metadata=_within(LOWEST_M, HIGHEST_M))  # .. and greatest
    unit_m: float = field(metadata=_within(0.01, 10.0))  # height per step
    known: int  # samples with a height
    name: str  # of the source
    datum: str
    source_posting_m: float | None = field(default=None, metadata=_within(0.01, 100_000.0))
    """Of the source; None: `posting_m`."""
    roughness_m: float | None = field(default=None, metadata=_within(0.0, 1000.0))
    """Root mean square difference of the heights of the source from those of the layer; None where
    the source is not finer."""

    @property
    def is_above_sea(self) -> bool:
        return UNKNOWN_DATUM not in self.datum.split(", ")

    @property
    def known_m2(self) -> float:
        return self.known * self.posting_m**2

    def to_plain(self) -> dict[str, Any]:
        known = {name: value for name, value in vars(self).items() if value is not None}
        return {"codec": "png", **known}

    @classmethod
    def from_plain(cls, plain: Any) -> "TerrainInfo":
        info = cls(**_fields(cls, plain))
        codec = _get(plain, "codec", str)
        if codec != "png":
            raise MapFileError(f"map has heights as {codec:.20}, png is read; build it again")
        sane = (
            _are_within(info)
            and min(info.rows, info.cols) >= 1
            and max(info.rows, info.cols) * info.posting_m <= 4 * MAX_SHEET_M
            and info.low_m <= info.high_m
            and (info.high_m - info.low_m) / info.unit_m <= MAX_CODE + 0.5
            and 0 <= info.known <= info.rows * info.cols
        )
        if not sane:
            raise MapFileError(f"map has an impossible terrain layer: {plain!r:.300}")
        return info


@dataclass(frozen=True)
class Lean:
    """How houses and trees lean in an orthophoto that is no true one: displaced by metres `east`
    and `north` per metre of height; `std`: per axis."""

    east: float = field(metadata=_within(-1, 1))
    north: float = field(metadata=_within(-1, 1))
    std: float = field(metadata=_within(0, 1))

    @classmethod
    def from_plain(cls, plain: Any) -> "Lean":
        lean = cls(**_fields(cls, plain))
        if not _are_within(lean):
            raise MapFileError(f"map has an impossible lean of its houses: {plain!r:.300}")
        return lean


@dataclass(frozen=True)
class SheetInfo:
    """`area_km2`: number of tiles times stride squared. `relief`: of ground without terrain, a key
    of `RELIEF_SLOPES`, None if nobody said. `surface`: of houses and trees above `terrain`, where
    the orthophoto shows them; `lean`: in it, None where not known."""

    frame: LocalFrame
    grid: TileGrid
    tiles: int
    area_km2: float
    grey: GreyInfo | None = None
    terrain: TerrainInfo | None = None
    relief: str | None = None
    surface: TerrainInfo | None = None
    lean: Lean | None = None

    def to_plain(self) -> dict[str, Any]:
        optional = {
            "terrain": self.terrain and self.terrain.to_plain(),
            "surface": self.surface and self.surface.to_plain(),
            "relief": self.relief,
            "lean": self.lean and vars(self.lean),
        }
        return {
            **{name: plain for name, plain in optional.items() if plain is not None},
            "origin_lat_deg": self.frame.lat_deg,
            "origin_lon_deg": self.frame.lon_deg,
            "grid": vars(self.grid),
            "tiles": self.tiles,
            "area_km2": self.area_km2,
            "grey": None if self.grey is None else self.grey.to_plain(),
        }

    @classmethod
    def from_plain(cls, plain: Any) -> "SheetInfo":
        raw = _get(plain, "grid", dict)
        grid = TileGrid(**_fields(TileGrid, raw))
        tiles = _get(plain, "tiles", int)
        sane = (
            grid.gsd_m > 0
            and 16 <= grid.tile_px <= MAX_TILE_PX
            and 1 <= grid.stride_px <= grid.tile_px
            and grid.rows >= 1
            and grid.cols >= 1
            and 1 <= tiles <= grid.rows * grid.cols
            and max(grid.width_px, grid.height_px) * grid.gsd_m <= 4 * MAX_SHEET_M
        )
        if not sane:
            raise MapFileError(f"map has an impossible tile grid: {raw}")
        try:
            frame = LocalFrame(_number(plain, "origin_lat_deg"), _number(plain, "origin_lon_deg"))
        except AreaError as error:
            raise MapFileError(f"map has an impossible sheet origin: {error}") from error
        known = {name: each for name, each in plain.items() if each is not None}
        info = cls(
            frame,
            grid,
            tiles,
            _number(plain, "area_km2"),
            grey=GreyInfo.from_plain(known["grey"], grid) if "grey" in known else None,
            terrain=TerrainInfo.from_plain(known["terrain"]) if "terrain" in known else None,
            relief=_get(known, "relief", str) if "relief" in known else None,
            surface=TerrainInfo.from_plain(known["surface"]) if "surface" in known else None,
            lean=Lean.from_plain(known["lean"]) if "lean" in known else None,
        )
        if info.surface is not None and info.terrain is None:
            raise MapFileError("map has a surface without the terrain that it stands on")
        if info.relief is not None and info.relief not in RELIEF_SLOPES:
            raise MapFileError(f"map has an unknown relief: {info.relief!r:.80}")
        if info.lean is not None and info.surface is None:
            raise MapFileError("map has a lean of its houses without a surface")
        return info


@dataclass(frozen=True)
class Manifest:
    """Everything in a map except its arrays.

    - `recipe`: method, representation and embedding with their parameters.
    - `sheets`: one for maps that fly. `imagery`: source files with dates and resolutions.
    - `view`: `heading_step_deg`, `min_valid_share`, `position_std_m`.
    - `confidence`: logistic regression, None if not fitted; `radius_m`: a fix within it is correct.
    - `registration`: the same for registered views, None without a registration layer.
    - `parts`: array name to {dtype, shape, sha256}; filled in by `write_map`.
    - `sha256`: of the manifest that was read, hexadecimal; empty if none was."""

    recipe: dict[str, Any]
    sheets: tuple[SheetInfo, ...]
    imagery: tuple[dict[str, Any], ...]
    view: dict[str, Any]
    confidence: dict[str, Any] | None
    radius_m: float
    created_by: str
    registration: dict[str, Any] | None = None
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)
    sha256: str = field(default="", init=False, compare=False)

    @property
    def area_km2(self) -> float:
        return sum(sheet.area_km2 for sheet in self.sheets)

    def to_json(self) -> str:
        """Canonical, with the SHA-256 of everything else in `manifest_sha256`."""
        sheets = [sheet.to_plain() for sheet in self.sheets]
        plain = vars(self) | {"format": FORMAT, "schema": SCHEMA, "sheets": sheets}
        plain.pop("sha256", None)  # set only where one was read
        return _canonical({**plain, "manifest_sha256": _digest(plain)})

    @classmethod
    def from_json(cls, text: str) -> "Manifest":
        """Raises `MapFileError` or `MapVersionError`."""
        if len(text) > 8 * 2**20:
            raise MapFileError("manifest of the map is larger than 8 MiB")
        try:
            plain = json.loads(text, parse_int=_integer)
        except (ValueError, RecursionError) as error:
            raise MapFileError(f"manifest of the map is not JSON ({error})") from error
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise MapFileError("not an orthonav map")
        schema = _get(plain, "schema", int)
        if schema > SCHEMA:
            raise MapVersionError(
                f"map has schema {schema}, this program reads up to {SCHEMA}; update orthonav"
            )
        stated = plain.pop("manifest_sha256", None)
        try:
            altered = stated != _digest(plain)
        except ValueError:  # a number that is not finite
            altered = True
        if schema < 1 or altered:
            raise MapFileError("manifest of the map was altered (checksum does not match)")
        sheets = _get(plain, "sheets", list)
        if not 1 <= len(sheets) <= 10_000:
            raise MapFileError(f"map must have 1 to 10000 sheets, has {len(sheets)}")
        confidence, registration = plain.get("confidence"), plain.get("registration")
        manifest = cls(
            recipe=_get(plain, "recipe", dict),
            sheets=tuple(SheetInfo.from_plain(sheet) for sheet in sheets),
            imagery=tuple(item for item in _get(plain, "imagery", list) if isinstance(item, dict)),
            view=_view(plain),
            confidence=confidence if isinstance(confidence, dict) else None,
            radius_m=_number(plain, "radius_m"),
            created_by=str(plain.get("created_by", "")),
            registration=registration if isinstance(registration, dict) else None,
            parts=_get(plain, "parts", dict),
        )
        object.__setattr__(manifest, "sha256", stated)  # no argument: `replace` must not copy it
        return manifest


def _view(plain: Any) -> dict[str, Any]:
    """Every heading tried takes an image in memory: a finer step would exhaust it."""
    view: dict[str, Any] = _get(plain, "view", dict)
    if not 0.5 <= _number(view, "heading_step_deg") <= 360:
        raise MapFileError(
            "manifest of the map: heading_step_deg must be 0.5 to 360, "
            f"got {view['heading_step_deg']!r:.80}"
        )
    return view


def _integer(text: str) -> int:
    if len(text) > 20:  # more digits than any number needs, few enough for a float
        raise ValueError(f"a number has {len(text)} digits")
    return int(text)


def _canonical(plain: Any) -> str:
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _digest(plain: dict[str, Any]) -> str:
    return hashlib.sha256(_canonical(plain).encode()).hexdigest()


def _get(plain: Any, name: str, kind: type) -> Any:
    value = plain.get(name) if isinstance(plain, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise MapFileError(
            f"manifest of the map: {name} must be {kind.__name__}, got {value!r:.80}"
        )
    return value


def _fields(record: type, plain: Any) -> dict[str, Any]:
    """Each of its type; raises `MapFileError`. Optional numbers may be absent."""
    found = {}
    for each in fields(record):
        kind: Any = each.type
        if kind == float | None:
            if plain.get(each.name) is None:
                continue
            kind = float
        value: Any = _number(plain, each.name) if kind is float else _get(plain, each.name, kind)
        found[each.name] = value[:MAX_NAME] if kind is str else value
    return found


def _number(plain: Any, name: str) -> float:
    value = plain.get(name) if isinstance(plain, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MapFileError(
            f"manifest of the map: {name} must be a finite number, got {value!r:.80}"
        )
    return float(value)
