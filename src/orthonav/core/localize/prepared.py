"""A map made ready for registration: what every search on it shares."""

from concurrent.futures import ThreadPoolExecutor

from orthonav.core.errors import MapFileError, VariantError
from orthonav.core.localize.confidence import RegisteredConfidence
from orthonav.core.localize.ground import SAMPLING, FlatTerrain, GroundModel
from orthonav.core.localize.plan import DEFAULT_PLAN, SearchPlan
from orthonav.core.localize.tiles import TileProposer
from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import SURFACE, TerrainLayer
from orthonav.core.register.search import SearchWindows
from orthonav.core.register.window import GreyPyramid, Reference


class PreparedMap:
    """The only sheet of a map, its imagery and its ground; threads may share it.

    `is_finer`: whether all views are compared one level finer than over bare ground."""

    def __init__(
        self,
        sheet: SheetInfo,
        layer: GreyPyramid,
        *,
        confidence: RegisteredConfidence | None,
        radius_m: float,
        floor_px: float,
        propose: TileProposer | None = None,
        plan: SearchPlan = DEFAULT_PLAN,
        terrain: TerrainLayer | None = None,
        surface: TerrainLayer | None = None,
    ) -> None:
        """`confidence`: None before it is learnt: no place is proven. `radius_m`: its error.

        `floor_px`: standard deviation with which maps of two dates agree, pixels of level 0.
        Without `propose` candidates come from FFT only; without `terrain` the ground is level."""
        self.sheet, self.grid = sheet, sheet.grid
        self.pool = ThreadPoolExecutor(plan.threads) if plan.threads > 1 else None
        self.reference = Reference(layer)
        self.windows = SearchWindows(self.reference)
        known_m2 = 0.0 if surface is None else surface.info.known_m2
        imagery_px = 0 if sheet.grey is None else sheet.grey.valid_px
        self.is_finer = known_m2 > SAMPLING.min_known * imagery_px * self.grid.gsd_m**2
        self.confidence, self.radius_m, self.floor_px = confidence, radius_m, floor_px
        self.propose, self.plan = propose, plan
        info = None if terrain is None else terrain.info
        self.ground = GroundModel(
            terrain or FlatTerrain(), self.grid, info, sheet.relief, surface, sheet.lean
        )

    @classmethod
    def of(
        cls,
        opened: MapFile,
        propose: TileProposer | None,
        plan: SearchPlan = DEFAULT_PLAN,
        *,
        level_ground: bool = False,
    ) -> "PreparedMap | None":
        """None without a registration layer. `level_ground`: as of `Localizer`.

        Raises `MapFileError` where the manifest's registration is damaged."""
        layer = GreyLayer.of(opened)
        if layer is None:
            return None
        plain = opened.manifest.registration or {}
        try:
            fitted = plain.get("confidence")
            confidence = None if fitted is None else RegisteredConfidence.from_plain(fitted)
            radius_m, floor_px = float(plain["radius_m"]), float(plain["position_floor_px"])
        except (VariantError, KeyError, TypeError, ValueError) as error:
            raise MapFileError(f"map cannot be flown ({error}): {opened.path}") from error
        if not (0 < radius_m < 1e9 and 0 <= floor_px < 1e9):  # squares of larger ones may overflow
            raise MapFileError(f"map has impossible registration parameters: {opened.path}")
        made = cls(
            opened.manifest.sheets[0],
            layer,
            confidence=confidence,
            radius_m=radius_m,
            floor_px=floor_px,
            propose=propose,
            plan=plan,
            terrain=TerrainLayer.of(opened),
            surface=TerrainLayer.of(opened, layer=SURFACE),
        )
        if level_ground:
            made.ground = made.ground.flattened()
        return made

    @property
    def pyramid(self) -> GreyPyramid:
        return self.reference.pyramid
