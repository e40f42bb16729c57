"""The sheets of an atlas as ground on which views are placed: opened when they are needed."""

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
from orthonav.localizer.prepared import PreparedView
from orthonav.localizer.registration import (
    RegistrationLocalizer,
)
from orthonav.mapfile import open_map
from orthonav.records import PRIOR_SIGMAS, NoFix, Prior, View
from orthonav.register.pose import Pose
from orthonav.register.registrar import Registered

log = logging.getLogger(__name__)

MAX_OPEN = 16
"""Sheets kept open: their decoded pictures take up to 64 MB each."""
BORDER_SHARE = 0.25
"""A sheet is looked at where the middle of a view may lie so much of its side beyond its box."""


@dataclass(frozen=True)
class Place:
    """Where a view may have been taken: camera, middle of what it sees, heading of its top, scale.

    `turn_std_rad` and `reach_m` say how far from there it is worth looking. `log_scale` is the
    logarithm of true over told height.
    """

    lat_deg: float
    lon_deg: float
    middle_latlon_deg: tuple[float, float]
    turn_rad: float
    log_scale: float
    reach_m: float
    turn_std_rad: float


@dataclass(frozen=True, eq=False)
class Sighting:
    """A view registered on a sheet: camera, heading, scale, their covariance (4, 4) in metres east
    and north, radians and log scale, and the evidence."""

    lat_deg: float
    lon_deg: float
    turn_rad: float
    log_scale: float
    covariance: NDArray[np.float64]
    evidence: Mapping[str, float]
    confidence: RegisteredConfidence | None
    radius_m: float


class Ground:
    """Sheets of an atlas with registration layers. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._names = atlas.recipe.sheets
        self._open: OrderedDict[str, RegistrationLocalizer] = OrderedDict()
        self._absent: set[str] = set()

    def register(self, view: View, place: Place, side_m: float) -> Sighting | None:
        """The best place of a view `side_m` wide around a place, None where it cannot be compared.

        On every sheet that may hold the middle of the view: sheets reach half a tile beyond their
        box. Raises `StorageError` where one cannot be fetched.
        """
        best: Sighting | None = None
        for name in self._near(place, side_m):
            sheet = self._at(name)
            found = None if sheet is None else _registered(sheet, view, place)
            if found and (not best or found.evidence["strength"] > best.evidence["strength"]):
                best = found
        return best

    def _near(self, place: Place, side_m: float) -> list[str]:
        """Names of the sheets within reach of the middle of a view."""
        lat, lon = place.middle_latlon_deg
        frame = LocalFrame(lat, lon)
        reach_m = place.reach_m + BORDER_SHARE * side_m
        corners = np.array([[-reach_m, -reach_m], [reach_m, reach_m]])
        lats, lons = frame.latlon_from_en(corners)
        box = float(lons[0]), float(lats[0]), float(lons[1]), float(lats[1])
        return list(self._names.over(box))

    def _at(self, name: str) -> RegistrationLocalizer | None:
        """What registers on a sheet, None where there is none or it is damaged: told once."""
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


def _registered(sheet: RegistrationLocalizer, view: View, place: Place) -> Sighting | None:
    told = replace(view.telemetry, yaw_deg=math.degrees(place.turn_rad))
    within = Prior(place.lat_deg, place.lon_deg, place.reach_m / PRIOR_SIGMAS)
    heading = place.turn_rad, place.turn_std_rad
    seen = sheet.register(replace(view, telemetry=told), within, heading_std_rad=heading)
    if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
        return None
    return _sighting(sheet, seen.prepared, seen.found)


def _sighting(sheet: RegistrationLocalizer, view: PreparedView, best: Registered) -> Sighting:
    pose: Pose = best.placed.pose
    lat, lon = sheet.sheet.frame.latlon_from_en(sheet.camera_en_m(view, pose))
    return Sighting(
        lat_deg=float(lat),
        lon_deg=float(lon),
        turn_rad=pose.turn_rad,
        log_scale=pose.log_scale,
        covariance=sheet.covariance(view, best.placed),
        evidence=best.evidence(),
        confidence=sheet.confidence,
        radius_m=sheet.radius_m,
    )
