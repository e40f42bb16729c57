"""The path from views to results, shared by recorded and live flights."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from orthonav.core.errors import CameraError, MapChangedError, MapFileError
from orthonav.core.flight.mount import Mount
from orthonav.core.localize.localizer import Localizer
from orthonav.core.records import Fix, NoFix, Telemetry, View
from orthonav.core.track import Model

log = logging.getLogger(__name__)
MAP_CHANGED = "map_file_changed"
MAP_DAMAGED = "map_damaged"
INTERNAL_ERROR = "internal_error"
LEAST_TILT_DEG = 0.1


class Locator(Protocol):
    def locate(self, view: View) -> Fix | NoFix:
        """Position of a view. Raises `CameraError` where the image has not the camera's size."""

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Position at a view whose image cannot be used, for `reason`."""

    @property
    def state_name(self) -> str | None: ...


@dataclass(frozen=True)
class SingleViews:
    localizer: Localizer
    use_prior: bool = True
    heading_known: bool = True
    state_name: str | None = None

    def locate(self, view: View) -> Fix | NoFix:
        return self.localizer.locate(
            view,
            prior=view.telemetry.prior if self.use_prior else None,
            heading_known=self.heading_known,
        )

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        return reason


@dataclass(frozen=True)
class MountCorrected:
    """A locator whose telemetry is corrected by a mount; its fixes report the remaining biases."""

    locator: Locator
    mount: Mount

    def locate(self, view: View) -> Fix | NoFix:
        return self.locator.locate(replace(view, telemetry=self.mount.corrected(view.telemetry)))

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        return self.locator.passed(self.mount.corrected(telemetry), reason)

    @property
    def state_name(self) -> str | None:
        return self.locator.state_name


def model_of(mount: Mount) -> Model:
    """Model whose remaining biases have the standard deviations of a mount's calibration."""
    heading, tilt = mount.heading_deg, max(mount.pitch_deg.std, mount.roll_deg.std)
    return Model(
        tilt_rad=math.radians(max(tilt, LEAST_TILT_DEG)),
        heading_rad=math.radians(max(heading.std, heading.scatter, 1.0)),
        log_scale=max(mount.log_scale.std, mount.log_scale.scatter, 0.01),
        off_mount=0.0,
    )


@dataclass(frozen=True)
class UnusableView:
    """A view whose picture cannot be used, for `reason`."""

    telemetry: Telemetry
    reason: NoFix


def locate_view(
    locator: Locator, view: View | UnusableView, failed: Callable[[], None] = lambda: None
) -> tuple[Fix | NoFix, float]:
    """Result of one view and the time taken in ms, NaN without a picture; after an internal error
    dead reckoning or a `NoFix`. `failed` is called at such an error.

    A map file that changed in place gives no position. Raises `CameraError`: it ends the flight.
    """
    if isinstance(view, UnusableView):
        return _passed(locator, view, failed), math.nan
    start = time.perf_counter()
    try:
        outcome = locator.locate(view)
    except CameraError:
        raise
    except MapChangedError as error:
        log.error("%s", error)
        outcome = NoFix(MAP_CHANGED, str(error))
    except Exception as error:  # one view must not end a flight
        failed()
        if isinstance(error, MapFileError):  # a crafted part of the map, decoded for this view
            log.error("%s", error)
            reason = NoFix(MAP_DAMAGED, str(error))
        else:
            log.exception("view could not be processed")
            reason = _internal(error)
        outcome = _passed(locator, UnusableView(view.telemetry, reason))
    else:
        outcome = finite(outcome)
        if isinstance(outcome, NoFix) and outcome.reason == INTERNAL_ERROR:
            failed()
    return outcome, (time.perf_counter() - start) * 1e3


def _passed(
    locator: Locator, view: UnusableView, failed: Callable[[], None] = lambda: None
) -> Fix | NoFix:
    try:
        outcome = finite(locator.passed(view.telemetry, view.reason))
    except Exception as error:
        log.exception("view could not be skipped")
        outcome = _internal(error)
    if isinstance(outcome, NoFix) and outcome.reason == INTERNAL_ERROR:
        failed()
    return outcome


def _internal(error: Exception) -> NoFix:
    return NoFix(INTERNAL_ERROR, f"{type(error).__name__}: {error}")


def finite(outcome: Fix | NoFix) -> Fix | NoFix:
    if isinstance(outcome, Fix) and not _is_finite(outcome):
        return NoFix(INTERNAL_ERROR, "the computed position is not finite")
    return outcome


def _is_finite(fix: Fix) -> bool:
    return bool(math.isfinite(fix.lat_deg + fix.lon_deg) and np.isfinite(fix.cov_en_m2).all())
