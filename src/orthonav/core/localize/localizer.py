"""A map, and the method that places views on it: registration, or tiles alone."""

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize.fix import fix_of
from orthonav.core.localize.plan import DEFAULT_PLAN, SearchPlan
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.search import Search
from orthonav.core.localize.tiles import TileLocalizer, TileProposer
from orthonav.core.localize.view import check_view
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import Fix, NoFix, Prior, View, has_type
from orthonav.core.tiles.position import PositionRule

HALF_EARTH_M = 2e7
"""A prior with a larger deviation excludes nothing."""


class Localizer:
    """Places views on one map; threads may share it once warm.

    `opened`: the map. `registration`: made ready for it, None where the map has no layer for it, or
    it was switched off.
    `sheet`: the part of the map that is flown on, with its `frame`, `grid` and layers. `grid`: size
    of pixels (`gsd_m`) and extent of its tiles in metres east and north of the frame."""

    def __init__(
        self,
        map: MapFile,
        *,
        registration: bool = True,
        position: PositionRule = "peak",
        flying: bool = True,
        level_ground: bool = False,
        plan: SearchPlan | None = None,
    ) -> None:
        """`map`: as of `orthonav.open_map`. Raises `MapFileError` where this program cannot fly it,
        `MissingExtraError` for onnxruntime, `ArgumentError` for what is no map.

        Without `registration`, or a layer for it, tiles place the views, by the rule `position`.
        Without `flying`, representations too slow to fly are accepted: only for maps of one's own,
        because networks are loaded from this machine. `level_ground`: for simulated views of
        flat ground, as well known as the map's terrain."""
        has_type("map", map, MapFile, ", as of orthonav.open_map(path)")
        if len(map.manifest.sheets) != 1:
            raise MapFileError(f"this program flies maps of one sheet: {map.path}")
        self.opened = map
        self.tiles = TileLocalizer(map, position=position, flying=flying)
        self.registration = None
        if registration:
            tiles = self.tiles
            propose = TileProposer.of(tiles.matcher, tiles.embedder, tiles.representation)
            self.registration = PreparedMap.of(
                map, propose, plan or DEFAULT_PLAN, level_ground=level_ground
            )

    def __repr__(self) -> str:
        kind = "tiles" if self.registration is None else "registration"
        return f"Localizer({self.opened.path}, {kind})"

    @property
    def sheet(self) -> SheetInfo:
        return self.tiles.sheet

    @property
    def grid(self) -> TileGrid:
        return self.tiles.sheet.grid

    @property
    def radius_m(self) -> float:
        """The error that the confidence of tile fixes is about."""
        return self.tiles.radius_m

    def locate(
        self, view: View, *, prior: Prior | None = None, heading_known: bool = True
    ) -> Fix | NoFix:
        """The position from which a view was taken.

        `prior` limits the search to three standard deviations around it. With `heading_known`
        false all headings are tried and the reported heading may be NaN. Any fault of a view makes
        a `NoFix`."""
        if prior is not None:
            has_type("prior", prior, Prior, "(lat_deg, lon_deg, std_m)")
        refused = check_view(view, self.grid.gsd_m, heading_known)
        if refused is not None:
            return refused
        if prior is not None:
            prior = replace(prior, std_m=min(prior.std_m, HALF_EARTH_M))
        if self.registration is None:
            found = self.tiles.locate(view, prior, heading_known)
        else:
            found = registered(self.registration, view, prior, heading_known)
        if prior is not None and isinstance(found, NoFix) and found.reason == "outside_map":
            hint = swapped_hint(prior.lat_deg, prior.lon_deg, self.opened.contains)
            return replace(found, detail=found.detail + hint)
        return found

    def localize(
        self,
        image: NDArray[Any] | None,
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
        """The position from which an image was taken; arguments and errors are those of `View.of`.

        `heading_deg` None: all headings are tried. `prior`: searched within three of its standard
        deviations; None: on the whole map. `tilt_std_deg`: how good pitch and roll are. None: 3 deg
        are assumed, and the tilt is estimated with the position, which costs accuracy: on a map
        without terrain the camera is placed to 3 % of the height, with 1 deg to 1.6 %. Crops of
        an orthophoto have none: 0."""
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


def registered(
    map: PreparedMap, view: View, prior: Prior | None, heading_known: bool
) -> Fix | NoFix:
    """The fix of a view that was checked; `NoFix` where it shows too little or fits nowhere."""
    search = Search.of(map, view, prior, heading_known)
    found = search if isinstance(search, NoFix) else search.run()
    return found if isinstance(found, NoFix) else fix_of(found)
