"""The path from views to results, shared by recorded and live flights."""

import logging
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from orthonav.core.errors import (
    CameraError,
    FlightError,
    MapChangedError,
    MapFileError,
    MissingFileError,
)
from orthonav.core.flight.heights import FlownHeights
from orthonav.core.flight.mount import Mount
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.localize.localizer import Localizer
from orthonav.core.records import Fix, NoFix, Telemetry, View, ViewResult
from orthonav.core.track import Model
from orthonav.core.track.tracker import Tracker

log = logging.getLogger(__name__)
MAP_CHANGED = "map_file_changed"
"""Reason of views after the open map file was truncated or rewritten."""
MAP_DAMAGED = "map_damaged"
"""Reason of a view for which a part of the map cannot be decoded."""
LEAST_TILT_DEG = 0.1


class Locator(Protocol):
    """Locates the views of one flight, one by one or as a track."""

    def locate(self, view: View) -> Fix | NoFix:
        """Position of a view. Raises `CameraError` where the image has not the camera's size."""

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Position at a view whose image cannot be used, for `reason`."""

    @property
    def state_name(self) -> str | None:
        """State of the track; None for single views."""


@dataclass(frozen=True)
class SingleViews:
    """Locates every view on its own."""

    localizer: Localizer
    use_prior: bool = True
    heading_known: bool = True
    state_name: str | None = None

    def locate(self, view: View) -> Fix | NoFix:
        """See `Localizer.locate`."""
        return self.localizer.locate(
            view,
            prior=view.telemetry.prior if self.use_prior else None,
            heading_known=self.heading_known,
        )

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Return `reason`: a single view has no other information."""
        return reason


@dataclass(frozen=True)
class MountCorrected:
    """A locator whose telemetry is corrected by a mount; its fixes report the remaining biases."""

    locator: Locator
    mount: Mount

    def locate(self, view: View) -> Fix | NoFix:
        """See `Locator.locate`."""
        return self.locator.locate(replace(view, telemetry=self.mount.corrected(view.telemetry)))

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """See `Locator.passed`."""
        return self.locator.passed(self.mount.corrected(telemetry), reason)

    @property
    def state_name(self) -> str | None:
        """See `Locator.state_name`."""
        return self.locator.state_name


def model_of(mount: Mount) -> Model:
    """Model of a flight whose telemetry is corrected by a mount: the biases that remain have the
    standard deviations of the calibration."""
    heading, tilt = mount.heading_deg, max(mount.pitch_deg.std, mount.roll_deg.std)
    tilt_rad = math.radians(max(tilt, LEAST_TILT_DEG))
    return replace(
        Model().with_mount(tilt_rad),
        heading_rad=math.radians(max(heading.std, heading.scatter, 1.0)),
        log_scale=max(mount.log_scale.std, mount.log_scale.scatter, 0.01),
        off_mount=0.0,
    )


def locate_view(locator: Locator, view: View) -> tuple[Fix | NoFix, float]:
    """Result of one view and the time taken in ms; an internal error becomes a `NoFix`.

    A map file that changed in place gives no position, not even that of a track. Raises
    `CameraError` only: a wrong camera is an error of the whole flight.
    """
    start = time.perf_counter()
    try:
        outcome = locator.locate(view)
    except CameraError:
        raise
    except MapChangedError as error:
        log.error("%s", error)
        outcome = NoFix(MAP_CHANGED, str(error))
    except MapFileError as error:  # a crafted part of the map, decoded for this view
        log.error("%s", error)
        outcome = _passed(locator, view.telemetry, NoFix(MAP_DAMAGED, str(error)))
    except Exception as error:  # one view must not end a flight
        log.exception("view could not be processed")
        outcome = _passed(locator, view.telemetry, _internal(error))
    return _finite(outcome), (time.perf_counter() - start) * 1e3


def localize_flight(
    locator: Locator,
    flight: Flight,
    *,
    skip_bad_images: bool = False,
    accept: Acceptance | None = None,
    views: Iterable[RecordedView] | None = None,
    heights: FlownHeights | None = None,
) -> Iterator[ViewResult]:
    """Results of the views of a recorded flight, in order, as they are computed.

    `heights`: turns reported heights into heights above ground; None: they are used as reported.
    With `accept` each result says whether its fix meets it. Raises `FlightError` or
    `MissingFileError` at an image that cannot be decoded or is missing, unless `skip_bad_images`
    makes it a `NoFix`; raises `CameraError` where an image has not the camera's aspect ratio.
    """
    for view in flight.views if views is None else views:
        outcome: Fix | NoFix
        telemetry = view.telemetry if heights is None else heights.corrected(view.telemetry)
        try:
            grey = view.grey()
        except (FlightError, MissingFileError) as error:
            if not skip_bad_images:
                raise
            reason = NoFix("bad_image", str(error))
            outcome = _finite(_passed(locator, telemetry, reason))
            latency_ms = math.nan
        else:
            try:
                seen = View(grey, flight.camera, telemetry)
                outcome, latency_ms = locate_view(locator, seen)
            except CameraError as error:
                raise CameraError(f"{error}: {view.where}") from error
        if heights is not None:
            heights.observe(telemetry.time_ns, outcome, locator.state_name)
        accepted = None if accept is None else accept.accepts(outcome)
        yield ViewResult(
            view.frame, telemetry.time_ns, outcome, latency_ms, locator.state_name, accepted
        )


def smoothed_track(
    tracker: Tracker, results: Sequence[ViewResult], accept: Acceptance | None
) -> list[ViewResult]:
    """Results of a whole flight after smoothing: every position uses all views."""
    placed = [_finite(outcome) for outcome in tracker.smoothed_track()]
    return [
        replace(
            result, outcome=outcome, accepted=None if accept is None else accept.accepts(outcome)
        )
        for result, outcome in zip(results, placed, strict=True)
    ]


def _passed(locator: Locator, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
    try:
        return locator.passed(telemetry, reason)
    except Exception as error:
        log.exception("view could not be skipped")
        return _internal(error)


def _internal(error: Exception) -> NoFix:
    return NoFix("internal_error", f"{type(error).__name__}: {error}")


def _finite(outcome: Fix | NoFix) -> Fix | NoFix:
    if isinstance(outcome, Fix) and not _is_finite(outcome):
        return NoFix("internal_error", "the computed position is not finite")
    return outcome


def _is_finite(fix: Fix) -> bool:
    return bool(math.isfinite(fix.lat_deg + fix.lon_deg) and np.isfinite(fix.cov_en_m2).all())
