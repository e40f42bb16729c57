"""What `orthonav calibrate` estimates from a flight: constant errors of the telemetry, and latency.

Latency is the time from the exposure of a picture to its arrival. The motion between consecutive
pictures is compared with the motion that follows from attitude, velocity and height reported at the
times of arrival less candidates of the latency, over windows of half a minute. What is known only
nearly (height, direction of the velocity, orientation of the camera) is estimated with it. A window
in which many candidates fit, as in straight and level flight, gives no number.

For a latency d, the seen turn of a pair of pictures is the reported one, `turn(d)`, and the seen
shift is

    tilt(d) + scale velocity(d) + across J velocity(d) + mount J tilt(d) + constant seconds

with J the rotation by 90 deg. These five linear parameters have Gaussian priors.
"""

import math
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import Bias, CameraLatency, Mount
from orthonav.core.flight.recording import Flight, RecordedView
from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.core.records import CONFIDENT, Fix, ViewResult
from orthonav.ground.recordings.flightlog import LoggedFlight
from orthonav.onboard.motion import (
    PAIR_INTERVAL,
    SHIFT_STD,
    TURN_STD_RAD,
    ImageMotion,
    PictureOdometry,
    ReportedMotion,
    explained_part,
    reported_motion,
    varying,
)

MIN_VIEWS = 5
MAD_TO_STD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""
_FLOORS = {"heading_deg": 0.2, "log_scale": 0.003, "pitch_deg": 0.3, "roll_deg": 0.3}
"""Lower bounds of the standard deviations of the biases, in the order of `TelemetryBias`."""
Array = NDArray[np.float64]
Times = NDArray[np.int64]
Prior = tuple[Array, Array]
"""Mean (5,) and precision (5, 5) of the linear parameters."""


@dataclass(frozen=True)
class LatencySearch:
    """How the latency is sought."""

    least_s: float = -0.5  # first candidate; an exposure after the arrival shows clocks that differ
    most_s: float = 12.0  # last candidate
    step_s: float = 0.1  # between candidates
    window_s: float = 30.0  # time over which pairs are compared
    most_pairs: int = 300
    least_pairs: int = 12
    pair_share: float = 0.9  # fraction of candidates for which the motion of a pair must be known
    known_share: float = 0.6  # fraction of pairs that must be known for each candidate
    near_s: float = 0.35  # a latency is found where the probability `near_mass` lies this close
    near_mass: float = 0.99
    largest_std_s: float = 0.3  # largest standard deviation of an answer
    floor_s: float = 0.025  # least one: half an interval of the stored states
    outlier: float = 3.0  # scale of the Cauchy weights, in standard deviations
    alike: float = 4.0
    """Differences of successive pairs are correlated: so many count as one. Chosen so that errors
    of the estimate are as large as stated (tests/onboard/test_calibrate_latency.py)."""

    @cached_property
    def candidates_s(self) -> Array:
        """Candidates (C,) of the latency."""
        steps = np.arange(round((self.most_s - self.least_s) / self.step_s) + 1, dtype=np.float64)
        return np.asarray(steps * self.step_s + self.least_s)


SEARCH = LatencySearch()


@dataclass(frozen=True)
class MountCalibration:
    mount: Mount
    first: str  # frame of the first view used
    last: str  # frame of the last one
    moved: bool  # whether the camera moved in its mount before `first`


def calibrate_mount(results: Sequence[ViewResult]) -> MountCalibration:
    """Mount at the end of a tracked flight: medians over its confident views.

    Views before a movement of the camera in its mount are excluded. Raises `FlightError` where
    fewer than `MIN_VIEWS` views are confident.
    """
    confident = confident_views(results)
    if len(confident) < MIN_VIEWS:
        raise FlightError(
            f"{len(confident)} of {len(results)} views have a confidence of {CONFIDENT} or more; a "
            f"calibration needs {MIN_VIEWS}: check the map, the camera and the reported height"
        )
    found = np.array([each.outcome.bias for each in confident if isinstance(each.outcome, Fix)]).T
    values, spreads = (dict(zip(_FLOORS, rows, strict=True)) for rows in (found[:4], found[4:]))
    begin = max(_still_from(values[name], spreads[name]) for name in ("pitch_deg", "roll_deg"))
    begin = min(begin, len(confident) - MIN_VIEWS)
    used = slice(begin, None)
    biases = {
        name: _bias(values[name][used], spreads[name][used], floor)
        for name, floor in _FLOORS.items()
    }
    mount = Mount(**biases, views=len(confident) - begin)
    return MountCalibration(mount, confident[begin].frame, confident[-1].frame, begin > 0)


def confident_views(results: Sequence[ViewResult]) -> list[ViewResult]:
    return [
        each
        for each in results
        if isinstance(each.outcome, Fix)
        and each.outcome.confidence >= CONFIDENT
        and math.isfinite(each.outcome.bias.heading_bias_deg)
    ]


def _still_from(values: Array, spreads: Array) -> int:
    """Index of the first view from which on a value stays close to that at the end."""
    end = float(np.median(values[-MIN_VIEWS:]))
    far = np.abs(values - end) > np.maximum(3.0 * spreads, 2.0)  # deg: the camera moved
    return int(np.flatnonzero(far)[-1]) + 1 if far.any() else 0


def _bias(values: Array, spreads: Array, floor: float) -> Bias:
    """Median, its standard deviation by the track, and the scatter around it."""
    middle = float(np.median(values))
    scatter = MAD_TO_STD * float(np.median(np.abs(values - middle)))
    return Bias(middle, max(floor, float(np.median(spreads))), scatter)


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

    Telemetry is interpolated between the exposures of the views. `heading_known`: whether the
    reported heading gives the direction of the velocity. Raises `FlightError` where the flight
    shows too little motion, or estimates disagree.
    """
    history = StateHistory(1.0)  # longest interval (s) over which telemetry is interpolated
    odometry, estimates = PictureOdometry(), list[LatencyEstimate | None]()
    waiting: deque[ImageMotion] = deque(maxlen=SEARCH.most_pairs)
    pairs: deque[tuple[ImageMotion, Array]] = deque(maxlen=SEARCH.most_pairs)
    candidates_ns = np.round(SEARCH.candidates_s * 1e9).astype(np.int64)
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
        motion = odometry.motion(grey, camera, arrived_ns)
        waiting.extend([] if motion is None else [motion])
        # A pair counts once the history reaches beyond all candidates.
        while waiting and waiting[0].end_ns - candidates_ns[0] <= history.newest_ns:
            one = waiting.popleft()
            shown = history.motion(one.start_ns - candidates_ns, one.end_ns - candidates_ns)
            if np.isfinite(shown[0]).mean() >= SEARCH.pair_share:
                pairs.append((one, np.column_stack(shown)))
        while pairs and pairs[0][0].start_ns < pairs[-1][0].end_ns - SEARCH.window_s * 1e9:
            pairs.popleft()
        if arrived_ns >= due_ns:
            due_ns = arrived_ns + 10.0 * 1e9
            estimates.append(_estimate(pairs, heading_known=heading_known))
    estimates.append(_estimate(pairs, heading_known=heading_known))
    return _agreed(estimates, intervals)


class StateHistory:
    def __init__(self, gap_s: float) -> None:
        """`gap_s`: longest interval between states that is interpolated."""
        self._gap_ns = round(gap_s * 1e9)
        self._times: Times = np.zeros(0, np.int64)
        self._rows: Array = np.zeros((0, 13))

    @property
    def newest_ns(self) -> int:
        return int(self._times[-1]) if len(self._times) else -(2**62)

    def add(
        self,
        time_ns: int,
        enu_from_camera: ArrayLike | None,
        velocity_enu_mps: ArrayLike | None,
        height_m: float,
    ) -> None:
        """Add a state; None and NaN: not known. A time that is not newer is ignored."""
        if time_ns <= self.newest_ns:
            return
        row = np.full(13, math.nan)
        if enu_from_camera is not None:
            row[:9] = np.ravel(enu_from_camera)
        if velocity_enu_mps is not None:
            row[9:12] = velocity_enu_mps
        row[12] = height_m if height_m > 0 else math.nan
        first = int(np.searchsorted(self._times, time_ns - 60 * 10**9))
        self._times = np.append(self._times[first:], time_ns)
        self._rows = np.concatenate([self._rows[first:], row[None]])

    def motion(self, start_ns: Times, end_ns: Times) -> ReportedMotion:
        start, end = self._at(start_ns), self._at(end_ns)
        seconds = float(end_ns[0] - start_ns[0]) / 1e9
        velocity, height = (start[:, 9:12] + end[:, 9:12]) / 2, start[:, 12]
        before, after = (each[:, :9].reshape(-1, 3, 3) for each in (start, end))
        return reported_motion(before, after, velocity, height, seconds)

    def _at(self, times_ns: Times) -> Array:
        if len(self._times) < 2:
            return np.full((len(times_ns), 13), math.nan)
        after = np.clip(np.searchsorted(self._times, times_ns), 1, len(self._times) - 1)
        begin, until = self._times[after - 1], self._times[after]
        weight = ((times_ns - begin) / (until - begin))[:, None]
        values = (1 - weight) * self._rows[after - 1] + weight * self._rows[after]
        known = (times_ns >= begin) & (times_ns <= until) & (until - begin <= self._gap_ns)
        return np.asarray(np.where(known[:, None], values, math.nan))


class LatencyEstimate(NamedTuple):
    """The latency (s) in one window, its standard deviation and the number of compared pairs."""

    delay_s: float
    std_s: float
    pairs: int


class _Fit(NamedTuple):
    """Fit of one latency to N pairs."""

    cost: float
    linear: Array  # (5,) parameters
    off: Array  # (N, 3) differences of turn and shift, seen less reported
    weights: Array  # (N,)

    def scatter(self) -> Array:
        """Standard deviations (2,) of turn and shift by the differences."""
        known = np.abs(self.off[self.weights > 0])
        return MAD_TO_STD * np.array([np.median(known[:, 0]), np.median(known[:, 1:])])

    def explained(self, seen: Array) -> float:
        """Least fraction of the motion seen (N, 4) that it explains, of turn and of the varying
        part of shift, where it is twice the least standard deviation; NaN where neither is."""
        turned = explained_part(seen[:, 1:2], self.off[:, :1], 2 * TURN_STD_RAD)
        shifts = varying(seen[:, 2:], seen[:, 0])
        return float(np.fmin(turned, explained_part(shifts, self.off[:, 1:], 2 * SHIFT_STD)))


def _estimate(
    pairs: Collection[tuple[ImageMotion, Array]], *, heading_known: bool
) -> LatencyEstimate | None:
    """The latency in a window, None where it is not observable."""
    if len(pairs) < SEARCH.least_pairs:
        return None
    # Seen (N, 4): seconds, turn, shift (2). Reported (N, C, 5): turn, tilt (2), velocity (2).
    motions = [(each.seconds, each.turn_rad, *each.shift) for each, _ in pairs]
    seen, reported = np.array(motions, np.float64), np.array([each for _, each in pairs])
    if (np.isfinite(reported[..., :3]).all(axis=-1).mean(axis=0) < SEARCH.known_share).any():
        return None  # a latency that cannot be excluded
    prior = _prior(reported, heading_known=heading_known)
    size = np.sqrt(np.square(np.nan_to_num(reported[:, ::20, 3:])).sum(axis=-1).mean())
    # Relief and changes of height: 8 % of the shift by velocity.
    noise = least = np.array([TURN_STD_RAD, np.hypot(SHIFT_STD, 0.08 * size)])
    for _ in range(2):  # the second time with the scatter of the first
        fits = [_fitted(seen, each, noise, prior) for each in np.moveaxis(reported, 1, 0)]
        cost = np.array([each.cost for each in fits])
        best = int(np.argmin(cost))
        fit = fits[best]
        noise = np.maximum(least, fit.scatter())
    chance = np.exp((cost[best] - cost) / (2 * SEARCH.alike))
    candidates_s = SEARCH.candidates_s
    near = np.abs(candidates_s - candidates_s[best]) <= SEARCH.near_s
    ambiguous = chance[near].sum() < SEARCH.near_mass * chance.sum()
    scale, across = fit.linear[:2].tolist()
    turned = abs(math.atan2(across, scale)) if heading_known else 0.0
    usual = 0.5 < math.hypot(scale, across) < 2.0 and turned < 0.6
    if fit.weights.mean() < 0.5 or ambiguous or not usual:
        return None
    # The minimum of a parabola through the least cost and its neighbours, and its curvature.
    middle = min(max(best, 1), len(cost) - 2)
    before, least_cost, after = cost[middle - 1 : middle + 2].tolist()
    bend = before - 2 * least_cost + after
    if not bend > 0:
        return None
    delay_s = float(candidates_s[middle]) + SEARCH.step_s * (before - after) / (2 * bend)
    std_s = math.hypot(SEARCH.floor_s, SEARCH.step_s * math.sqrt(2 * SEARCH.alike / bend))
    if std_s > SEARCH.largest_std_s or not fit.explained(seen) >= 0.6:
        return None
    return LatencyEstimate(delay_s, std_s, len(seen))


def _prior(reported: Array, *, heading_known: bool) -> Prior:
    unknown = ~np.isfinite(reported[..., 3]) & np.isfinite(reported[..., 0])
    # A constant shift per second: by an unknown velocity, else by the tilt of the mount.
    constant = 0.5 if unknown.any() else 0.01
    # Errors of height (fraction), direction of the velocity, orientation of the camera (rad).
    errors = (0.25, 0.2, 0.08) if heading_known else (1.5, 1.5, 0.08)
    mean = np.array([1.0 if heading_known else 0.0, 0.0, 0.0, 0.0, 0.0])
    std = np.array([*errors, constant, constant])
    return mean, np.diag(1 / np.square(std))


def _columns(seconds: Array, reported: Array) -> Array:
    """Derivatives (..., 2, 5) of the shift by the linear parameters; `reported` (..., 5)."""
    tilt, velocity = reported[..., 1:3], reported[..., 3:5]
    made = np.zeros((*reported.shape[:-1], 2, 5))
    made[..., 0], made[..., 1], made[..., 2] = velocity, _rotated(velocity), _rotated(tilt)
    made[..., 0, 3] = made[..., 1, 4] = seconds
    return made


def _rotated(vectors: Array) -> Array:
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def _fitted(seen: Array, reported: Array, noise: Array, prior: Prior) -> _Fit:
    """Fit of motions seen (N, 4) and `reported` (N, 5), with standard deviations `noise` (2,) of
    turn and shift."""
    known = np.asarray(np.isfinite(reported[:, :3]).all(axis=1), np.float64)
    reported = np.nan_to_num(reported)
    lines = _columns(seen[:, 0], reported)
    turn_off = seen[:, 1] - reported[:, 0]
    wanted = seen[:, 2:] - reported[:, 1:3]
    weights: Array = known
    for _ in range(3):
        flat = (lines * (weights / noise[1] ** 2)[:, None, None]).reshape(-1, 5)
        normal = flat.T @ lines.reshape(-1, 5) + prior[1]
        linear = np.linalg.solve(normal, flat.T @ wanted.reshape(-1) + prior[1] @ prior[0])
        shift_off = wanted - lines @ linear
        square: Array = np.square(turn_off / noise[0])
        square = square + np.square(shift_off / noise[1]).sum(axis=1)
        weights = known / (1 + square / SEARCH.outlier**2)
    # Cauchy's loss; where pairs are not known, as if all were.
    loss = float((known * np.log1p(square / SEARCH.outlier**2)).sum()) * SEARCH.outlier**2
    off = linear - prior[0]
    cost = loss * len(known) / max(known.sum(), 1.0) + float(off @ prior[1] @ off)
    return _Fit(cost, linear, np.column_stack([turn_off, shift_off]), weights)


def _agreed(estimates: list[LatencyEstimate | None], intervals: list[float]) -> CameraLatency:
    advice = (
        "fly at least two minutes at a height where the ground is textured, with turns of 10 deg/s "
        "or more or banking every 10 s, and log at least 2 views a second (`orthonav fly --log`)"
    )
    usual_s = float(np.median(intervals)) if intervals else math.inf
    if usual_s > PAIR_INTERVAL.max_s / 2:
        raise FlightError(
            f"views are {usual_s:.1f} s apart; the latency of a camera needs views at most "
            f"{PAIR_INTERVAL.max_s / 2:g} s apart: {advice}"
        )
    found, least = [each for each in estimates if each is not None], 3
    if len(found) < least:
        raise FlightError(
            f"the flight does not show the latency of the camera: {len(found)} of "
            f"{len(estimates)} windows give an estimate, {least} are needed: {advice}. "
            "If it was flown so, images do not move as the telemetry reports: check --mount-deg, "
            "the height and the heading"
        )
    delays = np.array([each.delay_s for each in found])
    stds = np.array([each.std_s for each in found])
    middle, agree_s = float(np.median(delays)), 0.1
    far = np.abs(delays - middle) > np.maximum(agree_s, 4.0 * stds)
    if far.mean() > 0.2:
        raise FlightError(
            f"the latency of the camera is not constant: {delays.min() * 1e3:.0f} to "
            f"{delays.max() * 1e3:.0f} ms during the flight"
        )
    if not -agree_s <= middle <= SEARCH.most_s:
        raise FlightError(
            f"images seem to be exposed {-middle * 1e3:.0f} ms after they arrived: the clocks of "
            "images and telemetry disagree"
        )
    std_s = max(float(np.median(stds)), float(np.std(delays[~far])))
    pairs = max(each.pairs for each in found)
    return CameraLatency(max(0.0, middle) * 1e3, std_s * 1e3, pairs)
