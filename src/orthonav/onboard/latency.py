"""Whether the stated latency of a live camera, from exposure to arrival, can be used.

Nothing is estimated in flight. A latency that is wrong, or that changed, shows in two ways: images
do not move as the autopilot reports, or the position jumps along the path of the aircraft.
Positions are then withheld until images move as reported again.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from orthonav.core.geo.attitude import LOOKS_DOWN, Angles
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.track.filter import usual_velocity_std_mps
from orthonav.onboard.cameras import GAP_S
from orthonav.onboard.motion import SIGMAS, WINDOW_S, Array, Grey, MotionCheck
from orthonav.onboard.telemetry import VehicleState

UNKNOWN, MISMATCH = "latency_unknown", "motion_mismatch"
MIN_STD_S = 0.03
"""Of a stated latency: one image at 30 Hz."""
MAX_STD_S = 0.3
"""A latency that is known less well is refused: 5 m at 15 m/s."""
MAX_GAP_S = 30.0
"""Positions farther apart are not compared."""
STEP_S = 0.5
"""Resolution of changes of the latency, and interval of the positions that are stored."""
CHANGES_S = np.arange(1, 25) * STEP_S
MeanVelocity = Callable[[int, int], tuple[float, float] | None]
"""Reported velocity (m/s east, north), mean between two times of our clock; None: not known."""


class _Place(NamedTuple):
    exposed_ns: int
    en_m: Array
    std_m: float


class LatencyMonitor:
    def __init__(
        self,
        stated_s: float | None = None,
        std_s: float = MIN_STD_S,
        *,
        mount_deg: Angles = LOOKS_DOWN,
        heading_known: bool = True,
    ) -> None:
        """`stated_s`: None: not stated. `heading_known`: the heading gives that of the velocity."""
        self._is_stated = stated_s is not None
        self.delay_s, self.std_s = stated_s or 0.0, max(std_s, MIN_STD_S)
        self._check = MotionCheck(self.delay_s, mount_deg, heading_known=heading_known)
        self._frame: LocalFrame | None = None
        self._places: deque[_Place] = deque(maxlen=round(5.0 / STEP_S))
        self._interruptions: int | None = None
        self._frozen_ns: int | None = None
        self._first_ns: int | None = None
        self._doubted_ns = 0
        self._comparing = self._contradicted = self._in_motion = False
        self._jump_s: float | None = None

    @property
    def may_locate(self) -> bool:
        """Whether nothing contradicts the latency; while images have not agreed with it yet, views
        are located and not sent."""
        known = self._is_stated and self.std_s <= MAX_STD_S
        return known and not self._contradicted and self._jump_s is None

    def reasons(self, now_ns: int = 0) -> list[str]:
        """Why positions are withheld, whatever the time."""
        reason, _ = self._doubt()
        return [] if reason is None else [reason]

    def detail(self) -> str:
        return self._doubt()[1]

    def plain(self) -> dict[str, float | str | None]:
        reason, detail = self._doubt()
        return {
            "latency_ms": round(self.delay_s * 1e3, 1) if self._is_stated else None,
            "latency_std_ms": round(self.std_s * 1e3, 1) if self._is_stated else None,
            "latency": f"{reason}: {detail}" if reason else "stated",
        }

    def arrived(self, arrived_ns: int, interruptions: int) -> None:
        """Call for all images, in the order of arrival. After the first one, `interruptions` and
        identical images the latency is compared with the images: it may have changed."""
        frozen_ns = arrived_ns if self._frozen_ns is None else self._frozen_ns
        if interruptions != self._interruptions or arrived_ns - frozen_ns > GAP_S * 1e9:
            self._interruptions = interruptions
            self._compare_again()

    def frozen(self, arrived_ns: int) -> None:
        """Call for an image that repeats the one before: the stream may be stalled."""
        if self._frozen_ns is None:
            self._frozen_ns = arrived_ns

    def observe(
        self,
        arrived_ns: int,
        grey: Grey,
        camera: Camera,
        state_at: Callable[[int], VehicleState],
        covered_ns: int | None,
    ) -> None:
        """Compare an image that is not frozen with the states, which are known to `covered_ns`."""
        self._frozen_ns = None
        if not self._is_stated or covered_ns is None:
            return
        if self._first_ns is None:
            self._first_ns = arrived_ns
        self._check.add(arrived_ns, grey, camera, state_at, covered_ns)
        found = self._check.compared()
        if found.agree or arrived_ns - self._first_ns > 5 * 10**9:  # without enough motion
            self._comparing = False
        if found.contradict:
            self._contradicted, self._doubted_ns = True, arrived_ns
            self._in_motion |= found.is_reported
        elif arrived_ns - self._doubted_ns > WINDOW_S * 1e9 and self._check.is_filled:
            # Calm and steady flight look alike at any latency: only varying motion clears it.
            # Motion that was seen and not reported was none of the aircraft, and is over.
            if found.agree or not self._in_motion:
                self._contradicted = self._in_motion = False
            self._jump_s = None if found.agree else self._jump_s

    def located(
        self,
        exposed_ns: int,
        latlon_deg: tuple[float, float],
        std_m: float,
        velocity: MeanVelocity,
    ) -> None:
        """Compare the position of a recognized view with those of the seconds before. One that
        jumped does not count later."""
        if self._frame is None:
            self._frame = LocalFrame(*latlon_deg)
        now = _Place(exposed_ns, np.asarray(self._frame.en_from_latlon(*latlon_deg)), std_m)
        changes = (_change_s(each, now, velocity) for each in self._places)
        jump_s = next((each for each in changes if each is not None), None)
        if jump_s is not None:
            self._jump_s, self._doubted_ns = jump_s, exposed_ns + round(self.delay_s * 1e9)
            self._compare_again()
        elif not self._places or exposed_ns - self._places[-1].exposed_ns >= STEP_S * 1e9:
            self._places.append(now)

    def _doubt(self) -> tuple[str | None, str]:
        if not self._is_stated:
            advice = "give --camera-latency-ms, as `orthonav calibrate --latency` measures it"
            return UNKNOWN, f"camera latency not known: {advice}"
        if not self.std_s <= MAX_STD_S:
            shown = f"camera latency known to {self.std_s * 1e3:.0f} ms only"
            return UNKNOWN, f"{shown}: measure it again"
        if self._contradicted:
            causes = "--camera-latency-ms, --mount-deg, the height and the heading"
            return MISMATCH, f"images do not move as the autopilot reports: check {causes}"
        if self._jump_s is not None:
            jumped = f"the position jumped as by a change of the latency of {self._jump_s:+.1f} s"
            return MISMATCH, f"{jumped}: it is withheld until images move as reported, in turns"
        if self._comparing:
            return UNKNOWN, "the stated camera latency is compared with the first images"
        return None, ""

    def _compare_again(self) -> None:
        self._comparing, self._first_ns = True, None
        self._check.clear()


def _change_s(before: _Place, now: _Place, velocity: MeanVelocity) -> float | None:
    """Growth of the latency by which the position jumped; None where it did not, or where no
    latency explains it."""
    seconds = (now.exposed_ns - before.exposed_ns) / 1e9
    mean = velocity(before.exposed_ns, now.exposed_ns) if 0 < seconds <= MAX_GAP_S else None
    if mean is None:
        return None
    residual = now.en_m - before.en_m - np.array(mean) * seconds
    std_m, std_mps = math.hypot(before.std_m, now.std_m), usual_velocity_std_mps(math.hypot(*mean))
    if not float(np.hypot(*residual)) > SIGMAS * math.hypot(std_m, std_mps * seconds):
        return None
    sizes = {
        change_s: float(np.hypot(*(residual - path)))
        / math.hypot(std_m, std_mps * (seconds + abs(change_s)))
        for change_s, path in _paths(now.exposed_ns, velocity)
    }
    best = min(sizes, key=sizes.__getitem__, default=math.nan)
    return best if sizes.get(best, math.inf) <= SIGMAS else None


def _paths(exposed_ns: int, velocity: MeanVelocity) -> list[tuple[float, Array]]:
    """Changes of the latency, and where the aircraft was then (2,), from where it was at the
    exposure; after the exposure as it flies now."""
    paths = []
    now = velocity(exposed_ns - round(STEP_S * 1e9), exposed_ns)
    for change_s in CHANGES_S.tolist():
        earlier = velocity(exposed_ns - round(change_s * 1e9), exposed_ns)
        if earlier is not None:
            paths.append((change_s, -change_s * np.array(earlier)))
        if now is not None:
            paths.append((-change_s, change_s * np.array(now)))
    return paths
