"""Registering views on the sheets of an atlas, which are opened when they are needed."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from orthonav.atlas.agreement import Placement
from orthonav.atlas.catalog import Atlas
from orthonav.confidence.registered import RegisteredConfidence
from orthonav.errors import AtlasError, MapFileError
from orthonav.geo.frames import LocalFrame
from orthonav.localizer import Localizer
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.mapfile import open_map
from orthonav.records import PRIOR_SIGMAS, NoFix, Prior, View

log = logging.getLogger(__name__)

MAX_OPEN = 16
"""Sheets kept open: their decoded pictures take up to 64 MB each, 1 GB in all."""
BORDER_SHARE = 0.25
"""Sheets reach half a tile beyond their box: a sheet is
searched where the middle of a view may lie up to this share of its side outside the box."""


@dataclass(frozen=True)
class SearchRegion(Placement):
    """A placement around which a view is registered.

    `middle_latlon_deg`: middle of the ground that the view shows.
    `reach_m`: how far from the place is searched.
    `turn_std_rad`: standard deviation of the heading.
    """

    middle_latlon_deg: tuple[float, float]
    reach_m: float
    turn_std_rad: float


@dataclass(frozen=True, eq=False)
class SheetMatch(Placement):
    """The placement of a view registered on a sheet.

    `evidence`: scores of the match and of its rivals.
    `confidence`: what the sheet makes of the evidence, None where it has learnt nothing.
    """

    evidence: Mapping[str, float]
    confidence: RegisteredConfidence | None


class SheetRegistrar:
    """Registers views on the sheets of an atlas. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._lattice = atlas.recipe.sheets
        self._usable = set(atlas.sheets())
        self._sheet = lru_cache(maxsize=MAX_OPEN)(self._opened)

    def register(self, view: View, region: SearchRegion, side_m: float) -> SheetMatch | None:
        """The best match of a view `side_m` wide in a region, None where it cannot be compared.

        All sheets that may hold the middle of the view are searched. Raises `StorageError` where a
        sheet cannot be fetched.
        """
        best: SheetMatch | None = None
        for name in self._near(region, side_m):
            sheet = self._sheet(name)
            found = None if sheet is None else _registered(sheet, view, region)
            if found and (not best or found.evidence["strength"] > best.evidence["strength"]):
                best = found
        return best

    def _near(self, region: SearchRegion, side_m: float) -> list[str]:
        """Names of the usable sheets within reach of the middle of a view."""
        frame = LocalFrame(*region.middle_latlon_deg)
        reach_m = region.reach_m + BORDER_SHARE * side_m
        lats, lons = frame.latlon_from_en(np.array([[-reach_m, -reach_m], [reach_m, reach_m]]))
        box = float(lons[0]), float(lats[0]), float(lons[1]), float(lats[1])
        return [name for name in self._lattice.over(box) if name in self._usable]

    def _opened(self, name: str) -> RegistrationLocalizer | None:
        """A sheet, None where it is damaged (logged once)."""
        try:
            return Localizer(open_map(self.atlas.path(self.atlas.sheets()[name]))).registration
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            self._usable.discard(name)
            return None


def _registered(
    sheet: RegistrationLocalizer, view: View, region: SearchRegion
) -> SheetMatch | None:
    telemetry = replace(view.telemetry, yaw_deg=math.degrees(region.turn_rad))
    prior = Prior(*region.latlon_deg, region.reach_m / PRIOR_SIGMAS)
    turned = replace(view, telemetry=telemetry)
    seen = sheet.register(turned, prior, heading_std_rad=region.turn_std_rad)
    if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
        return None
    pose = seen.found.placed.pose
    lat, lon = sheet.sheet.frame.latlon_from_en(sheet.camera_en_m(seen.prepared, pose))
    return SheetMatch(
        lat_deg=float(lat),
        lon_deg=float(lon),
        turn_rad=pose.turn_rad,
        log_scale=pose.log_scale,
        evidence=seen.found.evidence(),
        confidence=sheet.confidence,
    )
