"""Localization of recorded flights, by the same steps as in flight."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.flight.heights import FlownHeights
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.confidence import Acceptance
from orthonav.core.records import NoFix, Telemetry, View, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.onboard.run import MAP_CHANGED, Locator, UnusableView, finite, locate_view


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
    With `accept` each result says whether its fix meets it, and states the protection level at its
    risk. Raises `FlightError` or `MissingFileError` at an image that cannot be decoded or is
    missing, unless `skip_bad_images` makes it a `NoFix`; raises `CameraError` where an image has
    not the camera's aspect ratio.
    """
    for view in flight.views if views is None else views:
        telemetry = view.telemetry if heights is None else heights.corrected(view.telemetry)
        try:
            seen = _seen(view, flight.camera, telemetry, skip_bad_images)
            outcome, latency_ms = locate_view(locator, seen)
        except CameraError as error:
            raise CameraError(f"{error}: {view.where}") from error
        if heights is not None:
            heights.observe(telemetry.time_ns, outcome, locator.state_name)
        state, time_ns = locator.state_name, telemetry.time_ns
        result = ViewResult(view.frame, time_ns, outcome, latency_ms, state)
        yield result if accept is None else accept.judged(result)


def _seen(
    view: RecordedView, camera: Camera, telemetry: Telemetry, skip_bad_images: bool
) -> View | UnusableView:
    try:
        return View(view.grey(), camera, telemetry)
    except (FlightError, MissingFileError) as error:
        if not skip_bad_images:
            raise
        return UnusableView(telemetry, NoFix("bad_image", str(error)))


def smoothed_track(
    tracker: Tracker, results: Sequence[ViewResult], accept: Acceptance | None
) -> list[ViewResult]:
    """The results with smoothed positions; those of views that the tracker did not record, because
    of an error such as a map that changed, as they are."""
    placed = zip(tracker.recorded_ns, tracker.smoothed_track(), strict=True)
    ahead, smoothed = next(placed, None), []
    for result in results:
        changed = isinstance(result.outcome, NoFix) and result.outcome.reason == MAP_CHANGED
        if ahead is not None and ahead[0] == result.time_ns and not changed:
            result, ahead = replace(result, outcome=finite(ahead[1])), next(placed, None)
        smoothed.append(result)
    return smoothed if accept is None else [accept.judged(each) for each in smoothed]
