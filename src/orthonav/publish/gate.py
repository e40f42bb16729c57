"""What may go out: nothing unsure, nothing old, not too often; and what was withheld, and why.

An autopilot that is told a wrong place flies to a wrong place; one that is told nothing for a while
knows that. So the gate errs towards silence, and counts it.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.frames import LocalFrame
from orthonav.publish.estimate import (
    Clock,
    EstimateError,
    NavigationEstimate,
    error_ellipse,
)
from orthonav.records import CONFIDENT

FUTURE_S = 0.1
"""An exposure may lie this far after now before the clocks are said to disagree."""
JITTER = 0.1
"""Share of an interval by which a message may come early, so that views that come a little
unevenly at the rate that was asked for all pass."""
_MOST_NORTH_DEG = 89.8
Array = NDArray[np.float64]


@dataclass(frozen=True)
class GateRules:
    """What passes.

    `min_confidence` is the least confidence that is sent, `max_std_m` the largest standard
    deviation along the worst direction, `max_age_s` the longest time since exposure.
    `min_interval_s` names, per message, the shortest time between two of them; messages not named
    are not limited.

    The position counts as reset where it moved, against what velocity says, by more than
    `jump_sigmas` standard deviations of both positions together and what the aircraft can do:
    `max_accel_mps2` where the velocity is known (to `velocity_std_mps`, unless its covariance is
    told), `max_speed_mps` where it is not.

    Raises `EstimateError` for limits that are not positive, or a confidence beyond 0 to 1.
    """

    min_confidence: float = CONFIDENT
    max_std_m: float = 50.0
    max_age_s: float = 1.0
    min_interval_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    jump_sigmas: float = 5.0
    velocity_std_mps: float = 1.0
    max_accel_mps2: float = 10.0
    max_speed_mps: float = 60.0

    def __post_init__(self) -> None:
        limits = {
            "max_std_m": self.max_std_m,
            "max_age_s": self.max_age_s,
            "jump_sigmas": self.jump_sigmas,
            **{f"min_interval_s[{key}]": value for key, value in self.min_interval_s.items()},
        }
        for name, value in limits.items():
            if not value > 0:  # NaN too
                raise EstimateError(f"{name} must be above 0, got {value}")
        if not 0 <= self.min_confidence <= 1:
            raise EstimateError(f"min_confidence must be 0 to 1, got {self.min_confidence}")


class Gate:
    """Judges the estimates of one flight as they come. Mutable; not to be shared between threads.

    `withheld` counts reasons: `no_fix`, `not_tracking`, `low_confidence`, `no_covariance`,
    `too_uncertain`, `from_the_future`, `stale`, `out_of_order`, and `rate:NAME` for a message that
    came too soon. `sent` counts messages by name, `resets` how often the position jumped.
    """

    def __init__(self, rules: GateRules | None = None, clock: Clock = Clock.UTC) -> None:
        """`clock` is the one by which times of exposure and `now_ns` are compared."""
        self.rules = rules or GateRules()
        self.clock = clock
        self.withheld: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.resets = 0
        self._last: NavigationEstimate | None = None
        self._interrupted = False
        self._due_ns: dict[str, int] = {}

    def admit(self, estimate: NavigationEstimate | None, now_ns: int) -> NavigationEstimate | None:
        """The estimate with its reset counter set, or None where it must not be sent.

        `estimate` is None for a view without a fix. Hand in every view, also those that cannot
        pass: the gate learns from them that a track was lost. Raises `EstimateError` where the
        exposure is not known by the gate's clock.
        """
        reason = self._reason(estimate, now_ns)
        self._watch(estimate)
        if estimate is None or reason is not None:
            self.withheld[reason or "no_fix"] += 1
            return None
        if self._last is not None and (self._interrupted or self._jumped(self._last, estimate)):
            self.resets += 1
        self._interrupted = False
        self._last = replace(estimate, reset_counter=self.resets % 256)
        return self._last

    def due(self, message: str, now_ns: int) -> bool:
        """Whether `message` may be sent now, by its rate; counts it as sent or as withheld.

        Over a long time never more often than its interval says. `now_ns` may be of any clock that
        runs evenly; after it jumped back the next message passes.
        """
        interval_s = self.rules.min_interval_s.get(message)
        if interval_s is not None:
            interval_ns = round(interval_s * 1e9)
            early_ns = round(interval_ns * JITTER)
            due_ns = self._due_ns.get(message, now_ns)
            if now_ns < due_ns - interval_ns - early_ns:  # before the last message
                due_ns = now_ns
            if now_ns < due_ns - early_ns:
                self.withheld[f"rate:{message}"] += 1
                return False
            self._due_ns[message] = max(due_ns, now_ns - early_ns) + interval_ns
        self.sent[message] += 1
        return True

    def _reason(self, estimate: NavigationEstimate | None, now_ns: int) -> str | None:
        """Why the estimate must not be sent; None where it may."""
        if estimate is None:
            return "no_fix"
        exposed_ns, std_m = estimate.exposed_ns(self.clock), estimate.horizontal_std_m()
        age_s = (now_ns - exposed_ns) / 1e9
        behind_s = math.nan
        if self._last is not None:
            behind_s = (self._last.exposed_ns(self.clock) - exposed_ns) / 1e9
        refusals = {
            "not_tracking": estimate.state not in (None, "tracking"),
            "low_confidence": not estimate.confidence >= self.rules.min_confidence,  # NaN too
            "no_covariance": math.isnan(std_m),
            "too_uncertain": std_m > self.rules.max_std_m,
            "from_the_future": age_s < -FUTURE_S,
            "stale": age_s > self.rules.max_age_s,
            # Farther behind than that and yet not old: the clock was set back.
            "out_of_order": 0 <= behind_s <= self.rules.max_age_s + FUTURE_S,
        }
        return next((reason for reason, applies in refusals.items() if applies), None)

    def _watch(self, estimate: NavigationEstimate | None) -> None:
        """Note that a track was lost: a view without a place, or not tracking, after it was."""
        tracked = self._last is not None and self._last.state == "tracking"
        if tracked and (estimate is None or estimate.state != "tracking"):
            self._interrupted = True

    def _jumped(self, before: NavigationEstimate, now: NavigationEstimate) -> bool:
        """Whether the way between two positions is more than their errors and flight allow."""
        seconds = (now.exposed_ns(self.clock) - before.exposed_ns(self.clock)) / 1e9
        if seconds <= 0:
            return True
        velocities = [e.vel_en_mps for e in (before, now) if e.vel_en_mps is not None]
        moved = _moved_en_m(before, now)
        cov = np.asarray(before.cov_en_m2) + now.cov_en_m2
        if velocities:
            moved = moved - np.mean(velocities, axis=0) * seconds
            known = now.vel_cov_en if now.vel_cov_en is not None else before.vel_cov_en
            spread = np.eye(2) * self.rules.velocity_std_mps**2 if known is None else known
            cov = cov + np.asarray(spread) * seconds**2
            free_m = self.rules.max_accel_mps2 * seconds**2 / 2
        else:
            free_m = self.rules.max_speed_mps * seconds
        allowed_m = self.rules.jump_sigmas * error_ellipse(cov)[0] + free_m
        return not float(np.hypot(*moved)) <= allowed_m  # a covariance that is none too


def _moved_en_m(before: NavigationEstimate, now: NavigationEstimate) -> Array:
    """Metres east and north from one position to another."""
    limited = min(max(before.lat_deg, -_MOST_NORTH_DEG), _MOST_NORTH_DEG)
    frame = LocalFrame(limited, before.lon_deg)
    start = frame.en_from_latlon(before.lat_deg, before.lon_deg)
    return np.asarray(frame.en_from_latlon(now.lat_deg, now.lon_deg) - start)
