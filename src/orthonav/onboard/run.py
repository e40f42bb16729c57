"""One code path from views to results, for recorded flights and live ones alike."""

import logging
import math
import time
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.accept import Acceptance
from orthonav.errors import CameraError, FlightError
from orthonav.flight.folder import FlightFolder, FlightView, read_image
from orthonav.geo.camera import Camera
from orthonav.localizer.localizer import Localizer
from orthonav.records import Fix, NoFix, Telemetry, ViewResult

log = logging.getLogger(__name__)


def locate_view(
    localizer: Localizer,
    grey: NDArray[np.uint8],
    camera: Camera,
    telemetry: Telemetry,
    *,
    use_prior: bool,
    heading_known: bool,
) -> tuple[Fix | NoFix, float]:
    """Place one view; whatever goes wrong inside is a `NoFix`. Also the time taken, in ms.

    Raises `CameraError` only: a camera of another size is wrong for the whole flight.
    """
    start = time.perf_counter()
    try:
        outcome = localizer.locate(
            grey,
            camera,
            telemetry,
            prior=telemetry.prior if use_prior else None,
            heading_known=heading_known,
        )
        if isinstance(outcome, Fix) and not _is_finite(outcome):
            outcome = NoFix("internal_error", "the position came out as not a number")
    except CameraError:
        raise
    except Exception as error:  # One bad view never ends a flight.
        log.exception("view could not be processed")
        outcome = NoFix("internal_error", f"{type(error).__name__}: {error}")
    return outcome, (time.perf_counter() - start) * 1e3


def localize_flight(
    localizer: Localizer,
    flight: FlightFolder,
    *,
    use_prior: bool = True,
    heading_known: bool = True,
    skip_bad_images: bool = False,
    accept: Acceptance | None = None,
    views: Iterable[FlightView] | None = None,
) -> Iterator[ViewResult]:
    """Results for the views of a recorded flight, in order, as they are computed.

    Fixes that do not pass `accept` become `NoFix` with their evidence.
    Raises `FlightError` at an image that cannot be decoded, unless `skip_bad_images` makes it a
    `NoFix`; raises `CameraError` where the camera is not that of an image.
    """
    for view in flight.views if views is None else views:
        outcome: Fix | NoFix
        try:
            grey = read_image(view.path)
        except FlightError as error:
            if not skip_bad_images:
                raise
            outcome, latency_ms = NoFix("bad_image", str(error)), math.nan
        else:
            try:
                outcome, latency_ms = locate_view(
                    localizer,
                    grey,
                    flight.camera,
                    view.telemetry,
                    use_prior=use_prior,
                    heading_known=heading_known,
                )
            except CameraError as error:
                raise CameraError(f"{error}: {view.path}") from error
        if accept is not None:
            outcome = accept(outcome)
        yield ViewResult(view.frame, view.telemetry.time_ns, outcome, latency_ms)


def _is_finite(fix: Fix) -> bool:
    return bool(math.isfinite(fix.lat_deg + fix.lon_deg) and np.isfinite(fix.cov_en_m2).all())
