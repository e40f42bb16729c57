"""The sheets of an atlas as ground on which views are placed: opened when they are needed."""

import logging
import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.atlas.catalog import Atlas
from orthonav.errors import AtlasError, MapFileError
from orthonav.geo.camera import Camera
from orthonav.localizer import Localizer
from orthonav.localizer.registration import PreparedFootprint, RegistrationLocalizer
from orthonav.mapfile import open_map
from orthonav.records import NoFix, Prior, Telemetry
from orthonav.register.pose import Pose
from orthonav.register.registrar import Registered

log = logging.getLogger(__name__)

MAX_OPEN = 12
"""Sheets kept open: their decoded pictures take up to 64 MB each."""


@dataclass(frozen=True)
class Place:
    """Where a view may have been taken: camera, heading of the view's top, scale.

    `turn_std_rad` and `reach_m` say how far from there it is worth looking. `log_scale` is the
    logarithm of true over told height.
    """

    lat_deg: float
    lon_deg: float
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
    sheet: str


@dataclass(frozen=True, eq=False)
class ViewOnGround:
    """A view and what is told of it, to be registered on any sheet."""

    grey: NDArray[np.uint8]
    camera: Camera
    telemetry: Telemetry


class Ground:
    """Sheets of an atlas with registration layers. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._names = atlas.recipe.sheets
        self._open: OrderedDict[str, RegistrationLocalizer | None] = OrderedDict()

    def at(self, lat_deg: float, lon_deg: float) -> tuple[str, RegistrationLocalizer | None]:
        """The sheet that a place lies on, and what registers there; None where there is none.

        Raises `StorageError` where the sheet cannot be fetched. A sheet that is damaged counts as
        absent and is told of once.
        """
        name = self._names.name_at(lat_deg, lon_deg)
        if name in self._open:
            self._open.move_to_end(name)
            return name, self._open[name]
        found = self._opened(name)
        self._open[name] = found
        while len(self._open) > MAX_OPEN:
            self._open.popitem(last=False)
        return name, found

    def _opened(self, name: str) -> RegistrationLocalizer | None:
        sheet = self.atlas.sheets().get(name)
        if sheet is None:
            return None
        try:
            return Localizer(open_map(self.atlas.path(sheet))).registration
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            return None

    def register(self, view: ViewOnGround, place: Place) -> Sighting | None:
        """The best place of a view around a place, None where nothing can be compared."""
        name, sheet = self.at(place.lat_deg, place.lon_deg)
        if sheet is None:
            return None
        told = replace(view.telemetry, yaw_deg=math.degrees(place.turn_rad))
        prepared = sheet.prepared(view.grey, view.camera, told, True)
        if isinstance(prepared, NoFix):
            return None
        prior = replace(prepared.prior, turn_rad=place.turn_rad, turn_std_rad=place.turn_std_rad)
        prepared = replace(prepared, prior=prior)
        within = Prior(place.lat_deg, place.lon_deg, place.reach_m / 3)
        if not sheet.touches_map(within, prepared):
            return None
        best = sheet.best(prepared, within)
        return None if best is None else _sighting(name, sheet, prepared, best)


def _sighting(
    name: str, sheet: RegistrationLocalizer, view: PreparedFootprint, best: Registered
) -> Sighting:
    pose: Pose = best.placed.pose
    lat, lon = sheet.sheet.frame.latlon_from_en(sheet.camera_en_m(view, pose))
    return Sighting(
        lat_deg=float(lat),
        lon_deg=float(lon),
        turn_rad=pose.turn_rad,
        log_scale=pose.log_scale,
        covariance=sheet.covariance(view, best.placed),
        evidence=best.evidence(),
        sheet=name,
    )
