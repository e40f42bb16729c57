"""Whether GNSS holds the autopilot's filter, and how accurate its velocity and horizon are then.

A filter without GNSS, or one that fuses the positions of orthonav, has errors of velocity and tilt
that change within seconds and follow those positions. They are no independent measurement, so
they are reported with large standard deviations.
"""

import math

UNAIDED_VEL_STD_MPS = 5.0
"""Of the velocity without GNSS: that of PX4 was 2 to 5 m/s off in simulated flights, and changed
within 10 s."""
UNAIDED_TILT_STD_DEG, AIDED_TILT_STD_DEG = 3.0, 1.5
"""Of the horizon: PX4's was 2 to 4 deg off without GNSS. With GNSS, errors of the accelerometers
and of the mount remain; ArduPilot's was 0.4 deg off without it (docs/closed-loop.md)."""
LARGEST_AIDED_MPS = 1.0
"""A filter that claims a larger standard deviation of its velocity does not fuse GNSS, whatever the
receiver has."""
STATUS_NS, FIX_NS = 5 * 10**9, 3 * 10**9
"""A status and a fix hold for so long; the autopilots send both at 1 Hz or more."""
ABSOLUTE = 16
_IN_DOUBT = 128 | 1024 | 32768
FIX_3D = 3


class Aiding:
    """What the autopilot reported about its filter and its receivers. Mutable.

    Times are those of our clock.
    """

    def __init__(self, own_receiver: int | None = None) -> None:
        """`own_receiver`: number of the receiver in whose place orthonav sends GPS_INPUT."""
        self._own = own_receiver
        self._unaided_tilt_deg = UNAIDED_TILT_STD_DEG
        self._absolute_ns: int | None = None
        self._fixed_ns: int | None = None
        self._vel: tuple[int, float] | None = None

    def status(self, flags: int, now_ns: int, *, ardupilot: bool = False) -> None:
        """Take the flags of ESTIMATOR_STATUS or, by `ardupilot`, of EKF_STATUS_REPORT, which mean
        the same: an absolute position (16), but neither constant (128), nor a glitch or an
        uninitialized filter (1024), nor a glitch of GNSS (ArduPilot: 32768)."""
        self._unaided_tilt_deg = AIDED_TILT_STD_DEG if ardupilot else UNAIDED_TILT_STD_DEG
        aided = flags & ABSOLUTE and not flags & _IN_DOUBT
        self._absolute_ns = now_ns if aided else None

    def receiver(self, number: int, fix_type: int, now_ns: int) -> None:
        """Take the fix type of a receiver: 0 of GPS_RAW_INT, 1 of GPS2_RAW."""
        if number != self._own and fix_type >= FIX_3D:
            self._fixed_ns = now_ns

    def velocity(self, std_mps: float, now_ns: int) -> None:
        """Take the standard deviation that the filter claims for its velocity."""
        self._vel = (now_ns, std_mps) if math.isfinite(std_mps) else None

    def is_aided(self, now_ns: int) -> bool:
        """Whether GNSS holds the filter; False where that is not known."""
        return (
            _is_recent(self._absolute_ns, now_ns, STATUS_NS)
            and _is_recent(self._fixed_ns, now_ns, FIX_NS)
            and not self._claimed_mps(now_ns) > LARGEST_AIDED_MPS
        )

    def stds(self, now_ns: int) -> tuple[float, float]:
        """Standard deviations of velocity (m/s; NaN: as usual) and tilt (deg)."""
        if self.is_aided(now_ns):
            return math.nan, AIDED_TILT_STD_DEG
        return max(UNAIDED_VEL_STD_MPS, self._claimed_mps(now_ns)), self._unaided_tilt_deg

    def _claimed_mps(self, now_ns: int) -> float:
        """Standard deviation of the velocity by the filter; 0 where it is not known."""
        if self._vel is None or not _is_recent(self._vel[0], now_ns, STATUS_NS):
            return 0.0
        return self._vel[1]


def _is_recent(then_ns: int | None, now_ns: int, most_ns: int) -> bool:
    return then_ns is not None and now_ns - then_ns <= most_ns
