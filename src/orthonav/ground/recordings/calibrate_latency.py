"""Latency of a camera, estimated from a recorded flight."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import CameraLatency
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.ground.recordings.flightlog import LoggedFlight
from orthonav.onboard.delay import MOST_S, DelayEstimate, DelayEstimator
from orthonav.onboard.history import StateHistory
from orthonav.onboard.motion import LONGEST_S, PictureOdometry

GAP_S = 1.0
"""Longest interval between views over which telemetry is interpolated."""
EVERY_S = 10.0
"""Interval of estimates."""
LEAST = 3
"""Number of estimates that must agree."""
AGREE_S, AGREE_SIGMAS = 0.1, 4.0
NEEDED = (
    "fly at least two minutes at a height where the ground is textured, with turns of 10 deg/s or "
    "more or banking every 10 s, and log at least 2 views a second (`orthonav fly --log`)"
)


def arrivals_of(flight: Flight) -> Iterator[tuple[RecordedView, float]]:
    """Views of a recording, and the latency (s) that was subtracted from their arrival."""
    if isinstance(flight, LoggedFlight):
        yield from flight.arrivals()
        return
    for view in flight.views:
        yield view, 0.0


def calibrate_latency(
    camera: Camera,
    views: Iterable[tuple[RecordedView, float]],
    *,
    heading_known: bool = True,
) -> CameraLatency:
    """Latency of a camera from views and the latency (s) that their times already contain.

    Telemetry is interpolated between the exposures of the views. Raises `FlightError` where the
    flight shows too little motion, or estimates disagree.
    """
    history = StateHistory(GAP_S)
    odometry, estimator = PictureOdometry(), DelayEstimator(heading_known=heading_known)
    estimates: list[DelayEstimate] = []
    due_ns: float = -math.inf
    intervals = []
    before_ns = None
    for view, used_s in views:
        telemetry = view.telemetry
        known = not telemetry.missing()
        velocity = None if telemetry.vel_en_mps is None else (*telemetry.vel_en_mps, 0.0)
        attitude = telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg
        history.add(
            telemetry.time_ns,
            enu_from_camera(*attitude) if known else None,
            velocity,
            telemetry.agl_m,
        )
        arrived_ns = telemetry.time_ns + round(used_s * 1e9)
        if before_ns is not None:
            intervals.append((arrived_ns - before_ns) / 1e9)
        before_ns = arrived_ns
        try:
            grey = view.grey()
        except FlightError:
            continue
        estimator.add(odometry.motion(grey, camera, arrived_ns), history)
        if arrived_ns >= due_ns:
            due_ns = arrived_ns + EVERY_S * 1e9
            estimates.append(estimator.estimate())
    estimates.append(estimator.estimate())
    return _agreed(estimates, intervals)


def _agreed(estimates: list[DelayEstimate], intervals: list[float]) -> CameraLatency:
    if not intervals or float(np.median(intervals)) > LONGEST_S / 2:
        usual_s = float(np.median(intervals)) if intervals else math.inf
        raise FlightError(
            f"views are {usual_s:.1f} s apart; the latency of a camera needs views at most "
            f"{LONGEST_S / 2:g} s apart: {NEEDED}"
        )
    found = [each for each in estimates if each.found]
    contradicted = sum(each.contradicted for each in estimates)
    if contradicted > len(found):
        raise FlightError(
            "images do not move as the telemetry reports: check --mount-deg, the height and the "
            "heading"
        )
    if len(found) < LEAST:
        raise FlightError(
            f"the flight does not show the latency of the camera: {len(found)} of "
            f"{len(estimates)} windows give an estimate, {LEAST} are needed. "
            f"{NEEDED[0].upper()}{NEEDED[1:]}"
        )
    delays = np.array([each.delay_s for each in found])
    stds = np.array([each.std_s for each in found])
    middle = float(np.median(delays))
    far = np.abs(delays - middle) > np.maximum(AGREE_S, AGREE_SIGMAS * stds)
    if far.mean() > 0.2:
        raise FlightError(
            f"the latency of the camera is not constant: {delays.min() * 1e3:.0f} to "
            f"{delays.max() * 1e3:.0f} ms during the flight"
        )
    if not -AGREE_S <= middle <= MOST_S:
        raise FlightError(
            f"images seem to be exposed {-middle * 1e3:.0f} ms after they arrived: the clocks of "
            "images and telemetry disagree"
        )
    scatter = float(np.std(delays[~far]))
    std_s = max(float(np.median(stds)), scatter)
    pairs = max(each.pairs for each in found)
    return CameraLatency(max(0.0, middle) * 1e3, std_s * 1e3, pairs)
