"""Decides which positions are sent, and counts the reasons why others are withheld.

An autopilot detects missing positions, not wrong ones: the gate withholds positions in doubt.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT, error_ellipse
from orthonav.onboard.messages.estimate import EstimateError, NavigationEstimate

MAX_AGE_S = 1.0
"""Longest time since exposure."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class GateRules:
    """Limits of the gate.

    A position is a jump where it differs from the prediction by more than the deviations and the
    possible manoeuvre explain. It is withheld until `jump_views` in a row agree."""

    min_confidence: float = CONFIDENT  # 0 to 1
    max_std_m: float = 50.0  # along the worst direction
    min_interval_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Shortest time between two messages, by name."""
    alert_limit_m: float = math.inf  # of the protection level, above 0; infinite: none
    max_ahead_s: float = 0.1  # of an exposure before our clock
    jitter: float = 0.1  # fraction of an interval by which a message may be early
    jump_sigmas: float = 5.0
    jump_views: int = 3
    max_accel_mps2: float = 10.0  # where the velocity is known,
    max_speed_mps: float = 60.0  # and where it is not
    velocity_std_mps: float = 1.0  # where the velocity has no covariance

    def __post_init__(self) -> None:
        limits = {
            "max_std_m": self.max_std_m,
            "alert_limit_m": self.alert_limit_m,
            **{f"min_interval_s[{key}]": value for key, value in self.min_interval_s.items()},
        }
        for name, value in limits.items():
            if not value > 0:  # NaN too
                raise EstimateError(f"{name} must be above 0, got {value}")
        if not 0 <= self.min_confidence <= 1:
            raise EstimateError(f"min_confidence must be 0 to 1, got {self.min_confidence}")


class Decision(NamedTuple):
    """`estimate`: to be sent, with its reset counter; None where it is withheld for `reason`."""

    estimate: NavigationEstimate | None
    reason: str | None = None


class Gate:
    """Checks the estimates of one flight in order. Mutable; for one thread.

    Reasons: `no_fix`, `not_tracking`, `alert_limit`, `low_confidence`, `no_covariance`,
    `too_uncertain`, `from_the_future`, `stale`, `out_of_order`, `coasting` for dead reckoning,
    `jump` for an impossible one that no other view has confirmed, and `rate:NAME` for a message
    that would exceed its rate.
    `withheld`: counts by reason, also by those of the flight loop and of messages that cannot be
    made. `sent`: counts of messages by name. `resets`: number of admitted jumps of the position,
    and of tracks found again.
    """

    def __init__(self, rules: GateRules | None = None) -> None:
        self.rules = rules or GateRules()
        self.withheld: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.resets = 0
        self._last: NavigationEstimate | None = None
        self._interrupted = False
        self._jumped_to: list[NavigationEstimate] = []
        self._due_ns: dict[str, int] = {}
        self._protection_level_m = math.inf
        self._unavailable_ns: int | None = None

    def admit(self, estimate: NavigationEstimate | None, now_ns: int) -> Decision:
        """Whether an estimate may be sent at a time of its steady clock. Pass every view, also
        without a fix: it shows that a track was lost."""
        reason = self._reason(estimate, now_ns)
        self._watch(estimate, now_ns)
        if estimate is None or reason is not None:
            return self.withhold(reason or "no_fix")
        jumped = self._last is not None and self._jumped(self._last, estimate)
        if jumped and not self._is_confirmed(estimate):
            return self.withhold("jump")
        self._jumped_to = []
        if jumped or (self._last is not None and self._interrupted):
            self.resets += 1
        self._interrupted = False
        least, resets = self.rules.min_confidence, self.resets % 256
        self._last = replace(estimate, reset_counter=resets, min_confidence=least)
        return Decision(self._last)

    def withhold(self, reason: str) -> Decision:
        self.withheld[reason] += 1
        return Decision(None, reason)

    @property
    def is_unavailable(self) -> bool:
        """Whether the last protection level is above the alert limit."""
        return self._unavailable_ns is not None and math.isfinite(self.rules.alert_limit_m)

    def availability(self, now_ns: int) -> dict[str, float | None]:
        """The alert limit, the last protection level (None: infinite), and for how long it has kept
        positions from being sent; empty without a limit."""
        level_m, since_ns = self._protection_level_m, self._unavailable_ns
        if not math.isfinite(self.rules.alert_limit_m):
            return {}
        return {
            "alert_limit_m": self.rules.alert_limit_m,
            "protection_level_m": round(level_m, 1) if math.isfinite(level_m) else None,
            "unavailable_s": 0.0 if since_ns is None else round((now_ns - since_ns) / 1e9, 1),
        }

    def _is_confirmed(self, estimate: NavigationEstimate) -> bool:
        if self._jumped_to and self._jumped(self._jumped_to[-1], estimate):
            self._jumped_to = []
        self._jumped_to.append(estimate)
        return len(self._jumped_to) >= self.rules.jump_views

    def due(self, message: str, now_ns: int) -> bool:
        """Whether the rate of `message` allows sending now, which the next call takes as sent. The
        next one passes after a clock was set back."""
        interval_s = self.rules.min_interval_s.get(message)
        if interval_s is None:
            return True
        interval_ns = round(interval_s * 1e9)
        early_ns = round(interval_ns * self.rules.jitter)
        due_ns = self._due_ns.get(message, now_ns)
        if now_ns < due_ns - interval_ns - early_ns:  # before the last message
            due_ns = now_ns
        if now_ns < due_ns - early_ns:
            self.withhold(f"rate:{message}")
            return False
        self._due_ns[message] = max(due_ns, now_ns - early_ns) + interval_ns
        return True

    def _reason(self, estimate: NavigationEstimate | None, now_ns: int) -> str | None:
        if estimate is None:
            return "no_fix"
        std_m, age_s = estimate.horizontal_std_m(), (now_ns - estimate.time_ns) / 1e9
        behind_s = math.nan
        if self._last is not None:
            behind_s = (self._last.time_ns - estimate.time_ns) / 1e9
        refusals = {
            "coasting": estimate.state == "coasting",
            "not_tracking": estimate.state not in (None, "tracking"),
            "alert_limit": not estimate.protection_level_m <= self.rules.alert_limit_m,
            "low_confidence": not (
                estimate.accepted and estimate.confidence >= self.rules.min_confidence
            ),
            "no_covariance": math.isnan(std_m),
            "too_uncertain": std_m > self.rules.max_std_m,
            "from_the_future": age_s < -self.rules.max_ahead_s,
            "stale": age_s > MAX_AGE_S,
            # Farther behind, and not stale: the clock was set back.
            "out_of_order": 0 <= behind_s <= MAX_AGE_S + self.rules.max_ahead_s,
        }
        return next((reason for reason, applies in refusals.items() if applies), None)

    def _watch(self, estimate: NavigationEstimate | None, now_ns: int) -> None:
        """Note since when the alert limit is exceeded, and the loss of a track: a view without a
        fix, searching or lost, after tracking."""
        if estimate is not None:
            self._protection_level_m = estimate.protection_level_m
        if estimate is None or self._protection_level_m <= self.rules.alert_limit_m:
            self._unavailable_ns = None
        elif self._unavailable_ns is None:
            self._unavailable_ns = now_ns
        tracked = self._last is not None and self._last.state == "tracking"
        if tracked and (estimate is None or estimate.state not in ("tracking", "coasting")):
            self._interrupted = True

    def _jumped(self, before: NavigationEstimate, now: NavigationEstimate) -> bool:
        seconds = (now.time_ns - before.time_ns) / 1e9
        if seconds <= 0:
            return True
        rules = self.rules
        velocities = [e.vel_en_mps for e in (before, now) if e.vel_en_mps is not None]
        moved = _moved_en_m(before, now)
        cov = np.asarray(before.cov_en_m2) + now.cov_en_m2
        if velocities:
            moved = moved - np.mean(velocities, axis=0) * seconds
            known = now.vel_cov_en if now.vel_cov_en is not None else before.vel_cov_en
            spread = np.eye(2) * rules.velocity_std_mps**2 if known is None else known
            cov = cov + np.asarray(spread) * seconds**2
            free_m = rules.max_accel_mps2 * seconds**2 / 2
        else:
            free_m = rules.max_speed_mps * seconds
        allowed_m = rules.jump_sigmas * error_ellipse(cov)[0] + free_m
        return not float(np.hypot(*moved)) <= allowed_m  # true for an invalid covariance, too


def _moved_en_m(before: NavigationEstimate, now: NavigationEstimate) -> Array:
    # A frame has no longitudes at a pole.
    frame = LocalFrame(min(max(before.lat_deg, -89.8), 89.8), before.lon_deg)
    start = frame.en_from_latlon(before.lat_deg, before.lon_deg)
    return np.asarray(frame.en_from_latlon(now.lat_deg, now.lon_deg) - start)


def unavailable_text(availability: Mapping[str, float | None]) -> str:
    """Why and how long positions are withheld, of `Gate.availability`; "" while they pass."""
    if not availability.get("unavailable_s"):
        return ""
    level_m = availability["protection_level_m"]
    level = "infinite" if level_m is None else f"{level_m:.0f} m"
    return (
        f"protection level {level}, above the alert limit {availability['alert_limit_m']:g} m "
        f"for {availability['unavailable_s']:.0f} s"
    )
