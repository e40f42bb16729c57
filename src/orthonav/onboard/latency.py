"""Whether the stated latency of a live camera, from exposure to arrival, can be used.

Nothing is estimated in flight. A latency that is wrong, or that changed, shows in two ways: images
do not move as the autopilot reports, or the position jumps along the path of the aircraft. Fixes
are then withheld until images move as reported again.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from orthonav.core.geo.attitude import LOOKS_DOWN, Angles, enu_from_body_camera
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.track.motion import usual_velocity_std_mps
from orthonav.onboard.cameras import GAP_S
from orthonav.onboard.motion import (
    SHIFT_STD,
    TURN_STD_RAD,
    Array,
    Grey,
    ImageMotion,
    PictureOdometry,
    StateHistory,
    explained_part,
    varying,
)
from orthonav.onboard.telemetry import VehicleState

UNKNOWN, UNSTEADY, MISMATCH = "latency_unknown", "latency_unsteady", "motion_mismatch"
COMPARING = "the stated camera latency is compared with the first images"
LARGEST_STD_S = 0.3
"""A latency that is known less well is refused: 5 m at 15 m/s."""
STATED_STD_S = 0.03
"""Least standard deviation of a stated latency: one image at 30 Hz."""
FIRST_NS = 5 * 10**9
"""A latency is used after images agreed with it, or so long without enough motion."""
SAMPLE_NS, REACH_NS = 50_000_000, 18 * 10**9
"""Interval at which reported states are stored, and how far back after a time without images;
telemetry is kept for 20 s (`orthonav.onboard.telemetry.KEEP_NS`)."""
EXPLAINED, UNEXPLAINED = 0.6, 0.4
"""Fractions of the motion common to images and report from which they agree, and below which turns
contradict the latency."""
SECONDS, LEAST_PAIRS = 4.0, 12
"""Images of so many seconds are compared, at least so many pairs. After images or positions
contradicted the latency, nothing may contradict it for so long."""
SCALES = 0.4, 2.5
"""Range of the seen over the reported speed: height and heading may be off."""
LEAST_OFF = 0.016
"""Shift of the picture, less the reported one, over `SUMMED` pairs, from which it contradicts the
latency where they do not agree: errors of pitch and roll of PX4 without GNSS made up to 0.0143
(docs/closed-loop.md)."""
SUMMED, STANDS_OUT = 4, 3.0
"""Successive pairs that are summed; their motion counts from so many least standard deviations."""
OUTLIER, OUTLIER_SHARE, MAD_TO_STD = 6.0, 0.1, 1.4826
"""The worst pairs, beyond so many standard deviations, are left out, up to this share."""
KEEP_S, LONGEST_GAP_S = 5.0, 30.0
"""Earlier positions with which one is compared: a track moves to a new place within seconds. The
last one counts for longer: a track may have been coasting or lost since."""
SIGMAS = 3.0
LONGEST_S, LEAST_S, STEP_S = 12.0, 0.5, 0.1
"""Changes of the latency that are looked for."""


@dataclass(frozen=True)
class Latency:
    """`arrived_ns`: of an image, by our clock. `delay_s`, `std_s`: from its exposure; 0 and NaN
    where not stated. `reason`: why they must not be used. `detail`: one sentence about it."""

    arrived_ns: int
    delay_s: float
    std_s: float
    reason: str | None = None
    detail: str = ""

    @property
    def may_locate(self) -> bool:
        """Whether nothing contradicts them; a view with a `reason` is then located, and not sent,
        because images have not agreed yet."""
        return self.reason is None or self.detail == COMPARING


class LatencyMonitor:
    def __init__(
        self,
        stated_s: float | None = None,
        stated_std_s: float = STATED_STD_S,
        *,
        mount_deg: Angles = LOOKS_DOWN,
        heading_known: bool = True,
    ) -> None:
        """`stated_s`: None: not stated. `heading_known`: the heading gives that of the velocity."""
        self._is_stated, self._delay_s = stated_s is not None, stated_s or 0.0
        self._std_s = stated_std_s if self._is_stated else math.nan
        self._mount_deg = mount_deg
        self._odometry, self._history = PictureOdometry(), StateHistory()
        self._check = MotionCheck(self._delay_s, heading_known=heading_known)
        self._positions = PositionCheck()
        self._frame: LocalFrame | None = None
        self._sampled_ns: int | None = None
        self._doubted_ns = 0
        self._interruptions = 0
        self._frozen_ns: int | None = None
        self._first_ns: int | None = None
        self._compared = self._contradicted = self._in_motion = False
        self._jump_s: float | None = None

    def latency(self, arrived_ns: int, interruptions: int = 0) -> Latency:
        """The latency of an image; pass all in the order of arrival. After `interruptions` it is
        compared again, as at the start; positions from before show whether it grew."""
        frozen_ns = arrived_ns if self._frozen_ns is None else self._frozen_ns
        if interruptions != self._interruptions or arrived_ns - frozen_ns > GAP_S * 1e9:
            self._interruptions = interruptions
            self._compare_again()
        return Latency(arrived_ns, self._delay_s, self._std_s, *self._doubt())

    def frozen(self, arrived_ns: int) -> None:
        # The stream may be stalled.
        if self._frozen_ns is None:
            self._frozen_ns = arrived_ns

    def located(self, used: Latency, latlon_deg: tuple[float, float], std_m: float) -> str | None:
        """Reason to doubt the latency that was used after the position by an image, with its
        standard deviation: it jumped to a place where the aircraft was earlier or later."""
        if self._frame is None:
            self._frame = LocalFrame(*latlon_deg)
        en_m = np.asarray(self._frame.en_from_latlon(*latlon_deg), np.float64)
        exposed_ns = used.arrived_ns - round(used.delay_s * 1e9)
        jump_s = self._positions.jump_s(exposed_ns, en_m, std_m, self._history)
        if jump_s is not None:
            self._jump_s, self._doubted_ns = jump_s, used.arrived_ns
            self._compare_again()
        return self.reason

    def observe(
        self,
        arrived_ns: int,
        grey: Grey,
        camera: Camera,
        state_at: Callable[[int], VehicleState],
        covered_ns: int | None,
    ) -> None:
        # States are known to `covered_ns`.
        if not self._is_stated:
            return
        self._frozen_ns = None  # this image is not frozen
        if self._first_ns is None:
            self._first_ns = arrived_ns
        self._sample(state_at, covered_ns)
        self._check.add(self._odometry.motion(grey, camera, arrived_ns), self._history)
        found = self._check.compared()
        self._compared |= found.agree or arrived_ns - self._first_ns > FIRST_NS
        if found.contradict:
            self._contradicted, self._doubted_ns = True, arrived_ns
            self._in_motion |= found.is_reported
        elif arrived_ns - self._doubted_ns > SECONDS * 1e9 and self._check.is_filled:
            # Calm and steady flight look alike at any latency: only varying motion clears it.
            # Motion that was seen and not reported was none of the aircraft, and is over.
            if found.agree or not self._in_motion:
                self._contradicted = self._in_motion = False
            self._jump_s = None if found.agree else self._jump_s

    @property
    def reason(self) -> str | None:
        return self._doubt()[0]

    def plain(self) -> dict[str, float | str | None]:
        reason, detail = self._doubt()
        return {
            "latency_ms": round(self._delay_s * 1e3, 1) if self._is_stated else None,
            "latency_std_ms": round(self._std_s * 1e3, 1) if self._is_stated else None,
            "latency": f"{reason}: {detail}" if reason else "stated",
        }

    def _doubt(self) -> tuple[str | None, str]:
        if not self._is_stated:
            advice = "give --camera-latency-ms, as `orthonav calibrate --latency` measures it"
            return UNKNOWN, f"camera latency not known: {advice}"
        if not self._std_s <= LARGEST_STD_S:
            return (
                UNKNOWN,
                f"camera latency known to {self._std_s * 1e3:.0f} ms only: measure it again",
            )
        if self._contradicted:
            causes = "--camera-latency-ms, --mount-deg, the height and the heading"
            return MISMATCH, f"images do not move as the autopilot reports: check {causes}"
        if self._jump_s is not None:
            jumped = f"the position jumped as by a change of the latency of {self._jump_s:+.1f} s"
            return UNSTEADY, f"{jumped}: it is withheld until images move as reported, in turns"
        if not self._compared:
            return UNKNOWN, COMPARING
        return None, ""

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
            known = (east, north, -down) if math.isfinite(north + east + down) else None
            self._history.add(self._sampled_ns, attitude, known, state.height_m)

    def _compare_again(self) -> None:
        self._compared, self._first_ns = False, None
        self._odometry = PictureOdometry()
        self._check.clear()


class Compared(NamedTuple):
    """Whether images move as reported, steady turns apart, and whether they move otherwise: neither
    where little moved. `is_reported`: the aircraft moved by the report."""

    agree: bool = False
    contradict: bool = False
    is_reported: bool = False


class MotionCheck:
    def __init__(self, delay_s: float, *, heading_known: bool = True) -> None:
        self._delay_ns = round(delay_s * 1e9)
        self._heading_known = heading_known
        self._waiting: deque[ImageMotion] = deque(maxlen=100)
        self._rows: deque[tuple[int, Array]] = deque(maxlen=100)

    def clear(self) -> None:
        self._waiting.clear()
        self._rows.clear()

    def add(self, motion: ImageMotion | None, history: StateHistory) -> None:
        if motion is not None:
            self._waiting.append(motion)
        while self._waiting and self._waiting[0].end_ns - self._delay_ns <= history.newest_ns:
            one = self._waiting.popleft()
            start, end = (np.array([each - self._delay_ns]) for each in (one.start_ns, one.end_ns))
            turn, tilt, velocity = (each[0] for each in history.motion(start, end))
            reported = turn, *tilt, *velocity, *history.height_m(start)
            row = np.array([one.seconds, one.turn_rad, *one.shift, *reported])
            if np.isfinite(row[:7]).all():
                self._rows.append((one.end_ns, row))

    def compared(self) -> Compared:
        while self._rows and self._rows[0][0] < self._rows[-1][0] - SECONDS * 1e9:
            self._rows.popleft()
        if not self.is_filled:
            return Compared()
        pairs = np.array([row for _, row in self._rows])
        unknown = ~np.isfinite(pairs).all(axis=1)  # without the velocity only turns can be compared
        pairs[np.ix_(unknown, [2, 3, 5, 6, 7, 8])] = 0.0
        pairs = _sound(pairs)
        # Sums over successive pairs: jitter of the attitudes cancels, motion adds up.
        rows = np.lib.stride_tricks.sliding_window_view(pairs, SUMMED, axis=0).sum(axis=-1)
        seconds = rows[:, 0]
        # The constant part of the shift depends on height and heading, which may be off.
        velocity = rows[:, 7:9]
        seen_by_velocity = rows[:, 2:4] - rows[:, 5:7]
        reported_shift = varying(rows[:, 5:7] + velocity, seconds)
        turn_least, shift_least = STANDS_OUT * TURN_STD_RAD, STANDS_OUT * SHIFT_STD
        is_reported = bool(
            np.square(rows[:, 4]).mean() > turn_least**2
            or np.square(reported_shift).sum(axis=1).mean() > shift_least**2
        )
        turn = rows[:, 1:2], rows[:, 1:2] - rows[:, 4:5]
        varying_turn = varying(turn[0], seconds), varying(turn[1], seconds)
        shift = varying(rows[:, 2:4], seconds), varying(seen_by_velocity - velocity, seconds)
        shifted = explained_part(*shift, shift_least)
        turned = explained_part(*turn, turn_least)
        turning = explained_part(*varying_turn, turn_least)
        mps = np.median(pairs[:, 9]) / rows[:, :1]
        contradict = (
            turned < UNEXPLAINED
            or explained_part(*shift, shift_least, LEAST_OFF) < EXPLAINED
            or self._contradicts(mps * seen_by_velocity, mps * velocity)
        )
        agree = not contradict and bool(np.fmin(turning, shifted) >= EXPLAINED)
        return Compared(agree, contradict, is_reported)

    @property
    def is_filled(self) -> bool:
        return len(self._rows) >= LEAST_PAIRS

    def _contradicts(self, seen: Array, reported: Array) -> bool:
        # Velocities (N, 2) in m/s, beyond errors of the reported one and of the height.
        seen, reported = np.median(seen, axis=0), np.median(reported, axis=0)
        speed, seen_speed = (float(np.hypot(*each)) for each in (reported, seen))
        along = float(seen @ reported) / speed if self._heading_known and speed else seen_speed
        usual = SIGMAS * usual_velocity_std_mps(speed)
        return min(speed, abs(along - speed)) > usual and not (
            SCALES[0] < along / speed < SCALES[1]
        )


def _sound(pairs: Array) -> Array:
    off = np.concatenate([pairs[:, 1:2] - pairs[:, 4:5], pairs[:, 2:4] - pairs[:, 5:7]], axis=1)
    off[:, 1:] -= pairs[:, 7:9]
    off = np.abs(off - np.median(off, axis=0))
    least = np.array([TURN_STD_RAD, SHIFT_STD, SHIFT_STD])
    worst = (off / np.maximum(least, MAD_TO_STD * np.median(off, axis=0))).max(axis=1)
    count = math.ceil(OUTLIER_SHARE * len(pairs))
    limit = max(OUTLIER, float(np.sort(worst)[-count - 1]))
    return np.asarray(pairs[worst <= limit])


Place = tuple[int, Array, float]
"""Time of exposure, metres east and north (2,), standard deviation (m)."""


class PositionCheck:
    def __init__(self) -> None:
        self._places: deque[Place] = deque(maxlen=100)

    def jump_s(
        self, exposed_ns: int, en_m: Array, std_m: float, history: StateHistory
    ) -> float | None:
        """Growth of the latency (s) by which the position jumped; None without a jump or where no
        latency explains it. One that jumped does not count later."""
        now = exposed_ns, en_m, std_m
        while len(self._places) > 1 and self._places[0][0] < exposed_ns - KEEP_S * 1e9:
            self._places.popleft()
        if self._places:
            ago_s, path = _path(exposed_ns, history)
            jumps = (_jump_s(each, now, ago_s, path) for each in self._places)
            for found in jumps:
                if found is not None:
                    return found
        self._places.append(now)
        return None


def _path(exposed_ns: int, history: StateHistory) -> tuple[Array, Array]:
    """Times before an exposure (N,) (s, negative: after it), and where the aircraft was then
    (N, 2), metres from where it was at the exposure; NaN where the velocity is not known."""
    after, before = round(LONGEST_S / STEP_S), round(LONGEST_GAP_S / STEP_S)
    ago_s = np.arange(-after, before + 1) * STEP_S
    times_ns = exposed_ns - np.round(ago_s * 1e9).astype(np.int64)
    velocity = history.velocity(np.minimum(times_ns, history.newest_ns))
    velocity[times_ns > history.newest_ns + round(LEAST_S * 1e9)] = np.nan
    steps = (velocity[1:] + velocity[:-1]) / 2 * STEP_S
    later = np.cumsum(steps[:after][::-1], axis=0)[::-1]
    earlier = -np.cumsum(steps[after:], axis=0)
    return np.asarray(ago_s, np.float64), np.concatenate([later, np.zeros((1, 2)), earlier])


def _jump_s(before: Place, now: Place, ago_s: Array, path: Array) -> float | None:
    seconds = (now[0] - before[0]) / 1e9
    if not 0 < seconds <= LONGEST_GAP_S:
        return None
    flown = -np.array([np.interp(seconds, ago_s, each) for each in path.T])
    if not np.isfinite(flown).all():
        return None
    jump = now[1] - before[1] - flown
    speed_std = usual_velocity_std_mps(float(np.hypot(*flown)) / seconds)
    std_m = math.hypot(before[2], now[2])
    if not np.hypot(*jump) > SIGMAS * math.hypot(std_m, speed_std * seconds):
        return None
    usual = (np.abs(ago_s) >= LEAST_S) & (np.abs(ago_s) <= LONGEST_S)
    off = np.hypot(*(jump - path).T) / np.hypot(std_m, speed_std * (seconds + np.abs(ago_s)))
    off[~usual | np.isnan(off)] = np.inf
    best = int(np.argmin(off))
    return float(ago_s[best]) if off[best] <= SIGMAS else None
