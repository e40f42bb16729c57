"""Whether the pictures of the last seconds move as the autopilot reports at the delay in use.

It needs seconds, where an estimate of the delay needs the history of all candidates.
"""

import math
from collections import deque

import numpy as np

from orthonav.onboard.delay_fit import (
    MAD_TO_STD,
    SHIFT_STD,
    TURN_STD_RAD,
    Array,
    explained_share,
)
from orthonav.onboard.history import StateHistory
from orthonav.onboard.motion import ImageMotion

SECONDS = 4.0
LEAST_PAIRS = 12
LEAST_PER_S, SCALES = 0.03, (0.4, 2.5)
"""Shift per second by the velocity from which it is compared (3 m/s from 100 m), and the range of
the seen over the reported one: height and heading may be off."""
SUMMED, STANDS_OUT = 4, 3.0
"""Successive pairs that are summed; their motion counts from so many least standard deviations."""
OUTLIER, OUTLIER_SHARE = 6.0, 0.1
"""Pairs that differ by more than so many standard deviations are left out, the worst ones, up to
this share: one false motion of the picture is in four sums."""


class DelayCheck:
    """Compares pictures at one delay. Mutable."""

    def __init__(self, *, heading_known: bool = True) -> None:
        """`heading_known`: whether the reported heading gives the direction of the velocity."""
        self._heading_known = heading_known
        self._waiting: deque[tuple[ImageMotion, int]] = deque(maxlen=100)
        self._rows: deque[tuple[int, Array]] = deque(maxlen=100)

    def clear(self) -> None:
        """Forget all pictures."""
        self._waiting.clear()
        self._rows.clear()

    def add(self, motion: ImageMotion | None, history: StateHistory, delay_s: float) -> None:
        """Add the motion of a pair of pictures that arrived `delay_s` after exposure."""
        if motion is not None:
            self._waiting.append((motion, round(delay_s * 1e9)))
        while self._waiting:
            one, delay_ns = self._waiting[0]
            if one.end_ns - delay_ns > history.newest_ns:
                return
            self._waiting.popleft()
            times = (np.array([each - delay_ns]) for each in (one.start_ns, one.end_ns))
            moved = history.motion(*times)
            velocity = np.nan_to_num(moved.velocity_shift[0])
            turn, tilt = moved.turn_rad[0], moved.tilt_shift[0]
            row = np.array([one.seconds, one.turn_rad, *one.shift, turn, *tilt, *velocity])
            if np.isfinite(row).all():
                self._rows.append((one.end_ns, row))

    def share(self) -> float:
        """Share of the seen and the reported motion of the last seconds that is common to both; NaN
        where little moved."""
        while self._rows and self._rows[0][0] < self._rows[-1][0] - SECONDS * 1e9:
            self._rows.popleft()
        if len(self._rows) < LEAST_PAIRS:
            return math.nan
        pairs = _sound(np.array([row for _, row in self._rows]))
        # Sums over successive pairs: jitter of the attitudes cancels, motion adds up.
        rows = np.lib.stride_tricks.sliding_window_view(pairs, SUMMED, axis=0).sum(axis=-1)
        seconds = rows[:, :1]
        # The constant part of the shift depends on height and heading, which may be off.
        velocity = rows[:, 7:9]
        seen_by_velocity = rows[:, 2:4] - rows[:, 5:7]
        if self._contradicts(seen_by_velocity / seconds, velocity / seconds):
            return 0.0
        shift_off = seen_by_velocity - velocity
        shift_off = shift_off - np.median(shift_off / seconds, axis=0) * seconds
        turn_off = rows[:, 1] - rows[:, 4]
        return explained_share(
            rows[:, 0], rows[:, 1], rows[:, 2:4], turn_off, shift_off, STANDS_OUT
        )

    @property
    def is_filled(self) -> bool:
        """Whether there are enough pairs to compare."""
        return len(self._rows) >= LEAST_PAIRS

    def _contradicts(self, seen: Array, reported: Array) -> bool:
        """Whether shifts per second (N, 2) by the velocity differ beyond errors of height."""
        seen, reported = np.median(seen, axis=0), np.median(reported, axis=0)
        size = float(np.hypot(*reported))
        if size < LEAST_PER_S:
            return False
        along = float(seen @ reported) / size if self._heading_known else float(np.hypot(*seen))
        return not SCALES[0] < along / size < SCALES[1]


def _sound(pairs: Array) -> Array:
    """The rows (N, 9) without outliers."""
    off = np.concatenate([pairs[:, 1:2] - pairs[:, 4:5], pairs[:, 2:4] - pairs[:, 5:7]], axis=1)
    off[:, 1:] -= pairs[:, 7:9]
    off = np.abs(off - np.median(off, axis=0))
    least = np.array([TURN_STD_RAD, SHIFT_STD, SHIFT_STD])
    worst = (off / np.maximum(least, MAD_TO_STD * np.median(off, axis=0))).max(axis=1)
    count = math.ceil(OUTLIER_SHARE * len(pairs))
    limit = max(OUTLIER, float(np.sort(worst)[-count - 1]))
    return np.asarray(pairs[worst <= limit])
