"""Covariance for receivers that fuse positions as if their errors were independent.

The errors of consecutive fixes are nearly the same: the displacement of the map, the tilt of the
camera and the memory of the track last longer than a receiver averages. A receiver that takes n
such fixes as independent claims n times too small a variance. Each message is therefore given the
variance of the fix times the number of messages that the receiver averages, so that its claim is
the variance of the fix (docs/decisions/correlated-errors.md).
"""

import math
from dataclasses import dataclass, field, replace

from orthonav.core.geo.ellipse import error_ellipse
from orthonav.core.records import MAP_STD_M
from orthonav.onboard.messages.estimate import NavigationEstimate, floored

AVERAGING_S, AT_STD_M, EXPONENT = 5.0, 5.0, 0.4
"""Time over which the filters of autopilots average positions, s, where their claim should come to
the standard deviation `AT_STD_M`; it grows with this power of it. Derived from the default process
noise of PX4 and ArduPilot, 5.5 s, and chosen on generated flights
(docs/decisions/correlated-errors.md)."""


def messages_averaged(std_m: float, interval_s: float) -> float:
    """Number of messages, 1 or more, that a receiver averages.

    `std_m`: standard deviation that its claim should come to, m. `interval_s`: time since the
    message before, s; infinite for the first. A time that is not positive, after a clock was set
    back, counts as infinite.
    """
    if not interval_s > 0:
        return 1.0
    return max(AVERAGING_S * math.pow(std_m / AT_STD_M, EXPONENT) / interval_s, 1.0)


def for_filter(
    estimate: NavigationEstimate, interval_s: float, min_std_m: float = 0.0
) -> NavigationEstimate:
    """The estimate with the covariance that makes the claim of a receiving filter right.

    `interval_s`: time since the message before, see `messages_averaged`. `min_std_m`: lower bound
    of the standard deviation of the fix, at least that of the map's displacement, which does not
    average out. An invalid covariance stays
    as it is.
    """
    if math.isnan(estimate.horizontal_std_m()):
        return estimate
    cov = floored(estimate.cov_en_m2, max(MAP_STD_M, min_std_m))
    count = messages_averaged(error_ellipse(cov)[0], interval_s)
    return replace(estimate, cov_en_m2=cov * count)


@dataclass
class FilterCovariance:
    """Prepares the estimates of several messages, each by its own rate. Mutable.

    `min_std_m`: see `for_filter`.
    """

    min_std_m: float = 0.0
    _sent_ns: dict[str, int] = field(default_factory=dict)

    def interval_s(self, message: str, exposed_ns: int) -> float:
        """Time from the exposure of the last `message` sent, s; infinite for the first."""
        before = self._sent_ns.get(message)
        return math.inf if before is None else (exposed_ns - before) / 1e9

    def prepare(
        self, message: str, estimate: NavigationEstimate, exposed_ns: int
    ) -> NavigationEstimate:
        """The estimate for a `message` with an exposure at `exposed_ns` of a steady clock."""
        return for_filter(estimate, self.interval_s(message, exposed_ns), self.min_std_m)

    def sent(self, message: str, exposed_ns: int) -> None:
        """Note that `message` was sent."""
        self._sent_ns[message] = exposed_ns
