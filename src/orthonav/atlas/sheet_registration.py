"""Registering views on the sheets of an atlas, which are opened when they are needed."""

import logging
import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
class SearchRegion:
    """A place around which a view is registered.

    `lat_deg`, `lon_deg`: place of the camera.
    `middle_latlon_deg`: middle of the ground that the view shows.
    `turn_rad`: heading of the top of the view.
    `log_scale`: logarithm of true over reported height.
    `reach_m`: how far from the place is searched.
    `turn_std_rad`: standard deviation of the heading.
    """

    lat_deg: float
    lon_deg: float
    middle_latlon_deg: tuple[float, float]
    turn_rad: float
    log_scale: float
    reach_m: float
    turn_std_rad: float


@dataclass(frozen=True, eq=False)
class SheetMatch:
    """A view registered on a sheet.

    `lat_deg`, `lon_deg`: place of the camera.
    `turn_rad`: heading of the top of the view.
    `log_scale`: logarithm of true over reported height.
    `covariance` (4, 4): of metres east and north, heading (rad) and log scale.
    `evidence`: scores of the match and of its rivals.
    `confidence`: what the sheet makes of the evidence, None where it has learnt nothing.
    `radius_m`: error below which that confidence counts a fix as correct.
    """

    lat_deg: float
    lon_deg: float
    turn_rad: float
    log_scale: float
    covariance: NDArray[np.float64]
    evidence: Mapping[str, float]
    confidence: RegisteredConfidence | None
    radius_m: float


class SheetRegistrar:
    """Registers views on the sheets of an atlas. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._lattice = atlas.recipe.sheets
        self._open: OrderedDict[str, RegistrationLocalizer] = OrderedDict()
        self._absent: set[str] = set()

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
        """Names of the sheets within reach of the middle of a view."""
        frame = LocalFrame(*region.middle_latlon_deg)
        reach_m = region.reach_m + BORDER_SHARE * side_m
        lats, lons = frame.latlon_from_en(np.array([[-reach_m, -reach_m], [reach_m, reach_m]]))
        box = float(lons[0]), float(lats[0]), float(lons[1]), float(lats[1])
        return list(self._lattice.over(box))

    def _sheet(self, name: str) -> RegistrationLocalizer | None:
        """The opened sheet, None where it is missing or damaged (logged once)."""
        if name in self._absent:
            return None
        if name not in self._open:
            found = self._opened(name)
            if found is None:
                self._absent.add(name)
                return None
            self._open[name] = found
            while len(self._open) > MAX_OPEN:
                self._open.popitem(last=False)
        self._open.move_to_end(name)
        return self._open[name]

    def _opened(self, name: str) -> RegistrationLocalizer | None:
        sheet = self.atlas.sheets().get(name)
        if sheet is None:
            return None
        try:
            return Localizer(open_map(self.atlas.path(sheet))).registration
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            return None


def _registered(
    sheet: RegistrationLocalizer, view: View, region: SearchRegion
) -> SheetMatch | None:
    telemetry = replace(view.telemetry, yaw_deg=math.degrees(region.turn_rad))
    prior = Prior(region.lat_deg, region.lon_deg, region.reach_m / PRIOR_SIGMAS)
    turned = replace(view, telemetry=telemetry)
    seen = sheet.register(turned, prior, heading_std_rad=region.turn_std_rad)
    if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
        return None
    prepared, best = seen.prepared, seen.found
    pose = best.placed.pose
    lat, lon = sheet.sheet.frame.latlon_from_en(sheet.camera_en_m(prepared, pose))
    return SheetMatch(
        lat_deg=float(lat),
        lon_deg=float(lon),
        turn_rad=pose.turn_rad,
        log_scale=pose.log_scale,
        covariance=sheet.covariance(prepared, best.placed),
        evidence=best.evidence(),
        confidence=sheet.confidence,
        radius_m=sheet.radius_m,
    )
