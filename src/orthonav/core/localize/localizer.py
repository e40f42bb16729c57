"""The front of this package: one map, one method that places a view on it."""

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.checks import check_view
from orthonav.core.localize.plan import DEFAULT_PLAN, SearchPlan
from orthonav.core.localize.registration import RegistrationLocalizer
from orthonav.core.localize.tiles import TileLocalizer
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import Fix, NoFix, Prior, View
from orthonav.core.tiles.position import PositionRule

WIDEST_M = 2e7
"""Half of the Earth's circumference: a position known no better may be anywhere."""


class Localizer:
    """Places views on one map. Cheap to make, safe to share between threads once warm.

    `tiles` places views by their embedding, `registration` by registration on the map's imagery;
    `registration` is None where the map has no layer for it, or where it was not wanted.
    """

    def __init__(
        self,
        opened: MapFile,
        *,
        registration: bool = True,
        position: PositionRule = "peak",
        flying: bool = True,
        level_ground: bool = False,
        plan: SearchPlan | None = None,
    ) -> None:
        """Take an opened map; raises `MapFileError` if this program cannot fly it.

        Without `registration`, or where the map has no registration layer, views are localized by
        their tiles only; `position` is then the rule by which scores of tiles become a position.
        Without `flying`, maps whose representation is too slow to fly are accepted too: for
        experiments with maps of one's own, because such a representation loads networks from this
        machine. With `level_ground` the terrain of the map is not used for registration: for views
        that were simulated over level ground. Raises `MissingExtraError` where the map's encoder
        needs onnxruntime and it is not installed.
        """
        if len(opened.manifest.sheets) != 1:
            raise MapFileError(f"this program flies maps of one sheet: {opened.path}")
        self.opened = opened
        self.tiles = TileLocalizer(opened, position=position, flying=flying)
        self.registration = None
        if registration:
            self.registration = RegistrationLocalizer.of_map(
                opened, self.tiles.proposer(), plan or DEFAULT_PLAN, level_ground=level_ground
            )

    def __repr__(self) -> str:
        kind = "tiles" if self.registration is None else "registration"
        return f"Localizer({self.opened.path}, {kind})"

    @property
    def sheet(self) -> SheetInfo:
        """The map's only sheet."""
        return self.tiles.sheet

    @property
    def grid(self) -> TileGrid:
        """The tile grid of the sheet."""
        return self.tiles.sheet.grid

    @property
    def radius_m(self) -> float:
        """The error that the confidence of tile fixes is about, m."""
        return self.tiles.radius_m

    def locate(
        self, view: View, *, prior: Prior | None = None, heading_known: bool = True
    ) -> Fix | NoFix:
        """The position from which a view was taken.

        `prior` limits the search to three standard deviations around it. With `heading_known`
        false all headings are tried and the reported heading may be NaN. Any fault of a view makes
        a `NoFix`.
        """
        refused = check_view(view, self.grid.gsd_m, heading_known)
        if refused is not None:
            return refused
        if prior is not None and prior.std_m > WIDEST_M:
            prior = replace(prior, std_m=WIDEST_M)
        chosen = self.registration or self.tiles
        return chosen.locate(view, prior, heading_known)

    def localize(
        self,
        image: NDArray[Any],
        camera: Camera,
        *,
        agl_m: float,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        prior: Prior | None = None,
        heading_std_deg: float | None = None,
        agl_std_m: float | None = None,
        tilt_std_deg: float | None = None,
    ) -> Fix | NoFix:
        """The position from which an image was taken; for the arguments see `View.of`.

        `heading_deg` None: all headings are tried. `prior`: searched within three of its standard
        deviations; None: on the whole map. Raises `FlightError` for what is no image and
        `CameraError` where image and camera have different aspect ratios.
        """
        view = View.of(
            image,
            camera,
            agl_m=agl_m,
            heading_deg=heading_deg,
            pitch_deg=pitch_deg,
            roll_deg=roll_deg,
            heading_std_deg=heading_std_deg,
            agl_std_m=agl_std_m,
            tilt_std_deg=tilt_std_deg,
        )
        return self.locate(view, prior=prior, heading_known=heading_deg is not None)
