"""Decides which delay of a live camera is used, and when it is not known well enough.

The delay is known where it was stated or measured in flight. It is not known after a sign of a
change (in the arrivals, `orthonav.onboard.arrival`, or in the positions,
`orthonav.onboard.position_check`) until it has been measured again, while measurements contradict
it, and while the pictures do not move as the autopilot reports.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from orthonav.core.geo.attitude import LOOKS_DOWN, Angles, enu_from_body_camera
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.arrival import GAP_S, Arrival
from orthonav.onboard.delay import EXPLAINED, UNEXPLAINED, DelayEstimate, DelayEstimator
from orthonav.onboard.delay_check import DelayCheck
from orthonav.onboard.history import StateHistory
from orthonav.onboard.motion import Grey, PictureOdometry
from orthonav.onboard.position_check import PositionCheck
from orthonav.onboard.telemetry import VehicleState

UNKNOWN, UNSTEADY, MISMATCH = "latency_unknown", "latency_unsteady", "motion_mismatch"
EVERY_NS, DOUBT_EVERY_NS = 10**9, 5 * 10**8
"""Interval of estimates; the same while nothing can be sent."""
FIRST_NS = 5 * 10**9
"""A stated delay is used after images agreed with it, or after this time without enough motion to
tell."""
RECENT_S = 5.0
"""Pictures of so many seconds show a change that the whole window hides. With 8 s instead, growth
by 0.1 s/s made errors of 18 m before it showed, 9 m with 5 s (flights with computed pictures)."""
SAMPLE_NS, REACH_NS = 50_000_000, 18 * 10**9
"""Interval at which reported states are stored, and how far back, at the start and after a time
without images; telemetry is kept for 20 s (`orthonav.onboard.telemetry.BufferLimits`)."""
LARGEST_M, USUAL_MPS, LEAST_MPS = 4.0, 20.0, 5.0
"""A measured delay is known where its standard deviation times the speed is at most so many metres;
speed where none is reported, and least speed."""
STATED_STD_S = 0.03
"""Standard deviation of a stated delay: one image at 30 Hz."""
AGREE_S, AGREE_SIGMAS = 0.08, 3.0
"""Delays agree within the larger of both."""
WALK_S, LARGEST_WALK_S = 0.01, 0.1
"""Growth of the standard deviation since the measurement, per square root of a second, and its
limit: a delay without a sign of change stays in use, as a stated one does."""
DRIFTS, TOO_FAST = 0.008, 0.05
"""Drift (s/s) above which a delay is extrapolated, and above which it is not steady."""
EXTRAPOLATED_S = 15.0
"""Longest time for which a drifting delay is extrapolated."""
GROWN_S, GROWN_RATE = 0.15, 0.002
"""Growth of the delay by timestamps that counts as a change, and what clocks may add to it each
second."""
UNLIKE = "images do not move as reported at the latency in use"
SETTLED_S = 8.0
"""Images that moved unlike the report for a moment, without another sign of a change: the delay in
use is in doubt until they have not contradicted it for so long."""
BEFORE_S = 0.1
"""An exposure that is later than the arrival by more than this shows clocks that disagree."""


@dataclass(frozen=True)
class Latency:
    """The delay to use for one image.

    `delay_s`, `std_s`: exposure to arrival and its standard deviation; NaN where not known.
    `reason`: why it must not be used; None if it can be used. `detail`: one sentence about it.
    `stated`: whether it is the stated delay, not one that was measured in flight.
    """

    delay_s: float
    std_s: float
    reason: str | None = None
    detail: str = ""
    stated: bool = False


@dataclass(frozen=True)
class _Known:
    """A delay that is used; `measured_ns`: arrival of the last picture of the measurement."""

    delay_s: float
    std_s: float
    drift: float = 0.0
    measured_ns: int | None = None

    def at(self, arrived_ns: int) -> tuple[float, float]:
        """Delay and standard deviation for an arrival."""
        if self.measured_ns is None:
            return self.delay_s, self.std_s
        age_s = max(0.0, (arrived_ns - self.measured_ns) / 1e9)
        walk_s = min(WALK_S * math.sqrt(age_s), LARGEST_WALK_S)
        return self.delay_s + self.drift * age_s, math.hypot(self.std_s, walk_s)


class LatencyMonitor:
    """Measures and judges the delay of a live camera. Mutable; for one thread."""

    def __init__(
        self,
        stated_s: float | None = None,
        stated_std_s: float = STATED_STD_S,
        *,
        mount_deg: Angles = LOOKS_DOWN,
        heading_known: bool = True,
    ) -> None:
        """`stated_s`: delay as stated by the user, None: not stated."""
        self._stated = None if stated_s is None else _Known(stated_s, stated_std_s)
        self._known = self._stated
        self._mount_deg = mount_deg
        self._odometry, self._history = PictureOdometry(), StateHistory()
        self._estimator = DelayEstimator(heading_known=heading_known)
        self._check = DelayCheck(heading_known=heading_known)
        self._positions = PositionCheck()
        self._frame: LocalFrame | None = None
        self._sampled_ns: int | None = None
        self._due_ns: int | None = None
        self._pending: DelayEstimate | None = None
        self._suspicion = ""
        self._disputed = False
        self._unlike_ns = 0
        self._contradictions = 0
        self._changes: int | None = None
        self._anchor: tuple[int, float] | None = None
        self._grown = False
        self._arrival: Arrival | None = None
        self._frozen_ns: int | None = None
        self._first_ns: int | None = None
        self._compared = False

    def wants(self, arrived_ns: int) -> bool:
        """Whether an image that arrived then is compared with the one before."""
        return self._odometry.wants(arrived_ns)

    def latency(self, arrival: Arrival) -> Latency:
        """The delay to use for an image. Pass every image, in the order of arrival."""
        self._watch(arrival)
        return self._judged(arrival.arrived_ns)

    def located(
        self, arrival: Arrival, exposed_ns: int, latlon_deg: tuple[float, float], std_m: float
    ) -> Latency:
        """The delay after the position by an image: in doubt where that jumped to a place where the
        aircraft was earlier or later.

        `exposed_ns`: its time of exposure by the delay in use. `std_m`: standard deviation of the
        position.
        """
        if self._frame is None:
            self._frame = LocalFrame(*latlon_deg)
        en_m = np.asarray(self._frame.en_from_latlon(*latlon_deg), np.float64)
        change_s = self._positions.change_s(exposed_ns, en_m, std_m, self._history)
        if change_s is not None:
            why = f"the position jumped as by a change of the latency of {change_s:+.1f} s"
            self._suspect(why, arrival.arrived_ns)
        return self._judged(arrival.arrived_ns)

    def frozen(self, arrival: Arrival) -> None:
        """Note an image that repeats the one before: the stream may be stalled."""
        if self._frozen_ns is None:
            self._frozen_ns = arrival.arrived_ns

    def _judged(self, arrived_ns: int) -> Latency:
        if self._known is None:
            advice = "fly turns until it is measured, or give --camera-latency-ms"
            return Latency(math.nan, math.nan, UNKNOWN, f"camera latency not known: {advice}")
        delay_s, std_s = self._known.at(arrived_ns)
        reason, detail = None, ""
        if self._contradictions >= 2:
            detail = "images do not move as the autopilot reports: check the camera, --mount-deg"
            reason, detail = MISMATCH, f"{detail}, the height and the heading"
        elif self._suspicion:
            reason = UNSTEADY
            detail = f"{self._suspicion}: the camera latency must be measured again, in turns"
        elif not self._compared:
            reason, detail = UNKNOWN, "the stated camera latency is compared with the first images"
        elif self._drifted_away(arrived_ns):
            reason, detail = UNSTEADY, "the camera latency drifts and is not observable now"
        elif std_s * self._speed_mps() > 2 * LARGEST_M:
            reason, detail = UNKNOWN, f"camera latency known to {std_s * 1e3:.0f} ms only"
        return Latency(delay_s, std_s, reason, detail, self._known is self._stated)

    def observe(
        self,
        arrival: Arrival,
        grey: Grey,
        camera: Camera,
        state_at: Callable[[int], VehicleState],
        covered_ns: int | None,
    ) -> None:
        """Compare an image with the one before, and with the states that the autopilot reported.

        `state_at` gives the state at a time of our clock, known up to `covered_ns`.
        """
        self._frozen_ns = None  # this image is not frozen
        if self._first_ns is None:
            self._first_ns = arrival.arrived_ns
        self._compared |= arrival.arrived_ns - self._first_ns > FIRST_NS
        self._sample(state_at, covered_ns)
        motion = self._odometry.motion(grey, camera, arrival.arrived_ns)
        self._estimator.add(motion, self._history)
        if self._known is not None:
            delay_s, _ = self._known.at(arrival.arrived_ns)
            self._check.add(motion, self._history, delay_s)
        if self._due_ns is None or arrival.arrived_ns >= self._due_ns:
            doubt = self._judged(arrival.arrived_ns).reason is not None
            self._due_ns = arrival.arrived_ns + (DOUBT_EVERY_NS if doubt else EVERY_NS)
            recent = self._estimator.estimate(RECENT_S)
            decided = recent.found or recent.contradicted
            self._judge(recent if decided else self._estimator.estimate())
            self._compare(arrival.arrived_ns)

    def current(self) -> Latency:
        """The delay that was used last, or why it was not."""
        return self._judged(0 if self._arrival is None else self._arrival.arrived_ns)

    def plain(self) -> dict[str, float | str | None]:
        """What is known, for logs: `latency_ms`, `latency_std_ms`, and `latency`, where it comes
        from or why it is not used."""
        found = self.current()
        source = "stated" if found.stated else "measured"
        rounded = (
            None if math.isnan(each) else round(each * 1e3, 1)
            for each in (found.delay_s, found.std_s)
        )
        delay_ms, std_ms = rounded
        return {
            "latency_ms": delay_ms,
            "latency_std_ms": std_ms,
            "latency": f"{found.reason}: {found.detail}" if found.reason else source,
        }

    def _sample(self, state_at: Callable[[int], VehicleState], covered_ns: int | None) -> None:
        if covered_ns is None:
            return
        if self._sampled_ns is None or covered_ns - self._sampled_ns > REACH_NS:
            self._sampled_ns = covered_ns - REACH_NS
        while self._sampled_ns + SAMPLE_NS <= covered_ns:
            self._sampled_ns += SAMPLE_NS
            state = state_at(self._sampled_ns)
            turn = state.ned_from_body
            attitude = None if turn is None else enu_from_body_camera(turn, self._mount_deg)
            north, east, down = state.velocity_ned_mps
            velocity = north + east + down
            known = (east, north, -down) if math.isfinite(velocity) else None
            self._history.add(self._sampled_ns, attitude, known, state.height_m)

    def _watch(self, arrival: Arrival) -> None:
        """Notice changes in the arrivals."""
        self._arrival = arrival
        if self._changes is None:
            self._changes = arrival.changes
        if arrival.changes != self._changes:
            self._changes, self._anchor, self._grown = arrival.changes, None, False
            self._interrupted(arrival.why, arrival.arrived_ns)
        if self._frozen_ns is not None:
            stalled_s = (arrival.arrived_ns - self._frozen_ns) / 1e9
            if stalled_s > GAP_S:
                self._interrupted(f"the image was frozen for {stalled_s:.1f} s", arrival.arrived_ns)
        if math.isnan(arrival.grown_s):
            return
        if self._anchor is None:
            self._anchor = arrival.arrived_ns, arrival.grown_s
        since_ns, grown_s = self._anchor
        allowed_s = GROWN_S + GROWN_RATE * (arrival.arrived_ns - since_ns) / 1e9
        grown = abs(arrival.grown_s - grown_s) > allowed_s
        if grown and not self._grown:
            change_ms = (arrival.grown_s - grown_s) * 1e3
            self._suspect(f"images arrive {change_ms:+.0f} ms later", arrival.arrived_ns)
        elif self._grown and not grown:  # as late as before
            self._suspicion = ""
            self._start_again(arrival.arrived_ns)
        self._grown = grown

    def _interrupted(self, why: str, arrived_ns: int) -> None:
        """Note that images stopped for a while. A stated delay holds; it is compared with the
        images again, as at the start. Positions from before the gap show whether it grew."""
        if self._known is not self._stated:
            self._suspect(why, arrived_ns)
            return
        self._compared, self._first_ns = False, None
        self._forget_images(arrived_ns)

    def _suspect(self, why: str, arrived_ns: int) -> None:
        self._suspicion, self._disputed = why, False
        self._start_again(arrived_ns)

    def _start_again(self, arrived_ns: int) -> None:
        """Forget what is from before a change."""
        self._positions.clear()
        self._forget_images(arrived_ns)

    def _forget_images(self, arrived_ns: int) -> None:
        self._estimator.forget_before(arrived_ns)
        self._odometry.reset()
        self._check.clear()
        self._pending, self._contradictions = None, 0

    def _judge(self, found: DelayEstimate) -> None:
        if found.contradicted:
            self._contradictions += 1
            return
        if found.found:
            self._contradictions = 0
        if not found.found or found.std_s * self._speed_mps() > LARGEST_M:
            return
        if found.delay_s < -BEFORE_S or abs(found.drift) > TOO_FAST:
            before = found.delay_s < -BEFORE_S
            why = "images seem to arrive before exposure" if before else "the latency drifts fast"
            self._dispute(why, found)
            return
        # After a change, an estimate is not compared with the delay from before.
        known = None if self._suspicion and not self._disputed else self._known
        if known is not None:
            delay_s, std_s = known.at(found.last_ns)
            if _near(found.delay_s - delay_s, found.std_s, std_s):
                self._adopt(found)
                return
        if self._pending is not None and _agree(found, self._pending):
            self._adopt(found)
        elif known is None:
            self._pending = found
        else:
            delay_ms = known.at(found.last_ns)[0] * 1e3
            measured = f"measured {found.delay_s * 1e3:.0f} ms, used {delay_ms:.0f} ms"
            self._dispute(measured, found)

    def _compare(self, arrived_ns: int) -> None:
        """Dispute the delay in use where the last seconds do not fit it."""
        share = self._check.share()
        if share >= UNEXPLAINED:
            self._contradictions = 0
            self._compared |= share >= EXPLAINED  # a delay that is a little off explains some
        if share < UNEXPLAINED:
            self._unlike_ns = arrived_ns
            if not self._suspicion:
                self._suspicion, self._disputed, self._pending = UNLIKE, True, None
        elif self._suspicion == UNLIKE and self._check.is_filled:
            # Not at once: steady turns look alike at many delays.
            settled = arrived_ns - self._unlike_ns > SETTLED_S * 1e9
            self._suspicion = "" if settled else UNLIKE

    def _dispute(self, why: str, found: DelayEstimate) -> None:
        """Withhold until the next estimate agrees with this one or with what was known."""
        self._suspicion, self._disputed, self._pending = why, True, found

    def _adopt(self, found: DelayEstimate) -> None:
        stated = self._stated
        changed = self._known is None or not _near(
            found.delay_s - self._known.at(found.last_ns)[0], found.std_s, 0.0
        )
        if stated is not None and _near(found.delay_s - stated.delay_s, found.std_s, stated.std_s):
            self._known = stated
        else:
            drift = found.drift if abs(found.drift) > DRIFTS else 0.0
            self._known = _Known(found.delay_s, found.std_s, drift, found.last_ns)
        if changed:  # older pictures belong to another delay
            self._estimator.forget_before(found.last_ns - round(RECENT_S * 1e9))
            self._check.clear()
            self._positions.clear()
        self._suspicion, self._disputed, self._pending, self._grown = "", False, None, False
        self._compared = True
        if self._arrival is not None and math.isfinite(self._arrival.grown_s):
            self._anchor = self._arrival.arrived_ns, self._arrival.grown_s

    def _drifted_away(self, arrived_ns: int) -> bool:
        known = self._known
        if known is None or known.measured_ns is None or known.drift == 0.0:
            return False
        return arrived_ns - known.measured_ns > EXTRAPOLATED_S * 1e9

    def _speed_mps(self) -> float:
        speed = self._history.speed_mps()
        return max(LEAST_MPS, speed) if math.isfinite(speed) else USUAL_MPS


def _near(off_s: float, std_s: float, other_std_s: float) -> bool:
    return abs(off_s) <= max(AGREE_S, AGREE_SIGMAS * math.hypot(std_s, other_std_s))


def _agree(one: DelayEstimate, other: DelayEstimate) -> bool:
    """Whether two estimates agree; False where one of them was not found."""
    moved_s = other.drift * (one.last_ns - other.last_ns) / 1e9
    return _near(one.delay_s - other.delay_s - moved_s, one.std_s, other.std_s)
