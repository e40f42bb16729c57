"""Signs in the arrival of images that the delay of the camera changed.

A gap in the arrivals: what comes after it may be late by as much. The timestamps of the stream
against the times of arrival: they show growth of the delay, where they are those of the camera and
not counted at a nominal rate.
"""

import math
from collections import deque
from dataclasses import dataclass

GAP_S = 0.5
"""A longer time without images may change the delay. Shorter ones are usual on a busy computer."""
GAP_INTERVALS = 3.0
"""The same in usual intervals between images, for slow cameras."""
CHECKED_S = 10.0
"""Timestamps are compared for so long before they are used."""
RATE_ERROR = 0.002
"""Largest difference of the rates of timestamps and arrivals. Nominal rates differ by more."""
WINDOW_S = 1.0
"""The least delay of arrivals counts over so many seconds: single images may be late."""


@dataclass(frozen=True)
class Arrival:
    """Arrival of one image.

    `arrived_ns`: time by our monotonic clock. `changes`: how often the delay may have changed since
    the start. `why`: cause of the last change. `grown_s`: growth of the delay by the timestamps,
    since these were found valid; NaN where there are none, or they are not valid.
    """

    arrived_ns: int
    changes: int = 0
    why: str = ""
    grown_s: float = math.nan


class ArrivalWatch:
    """Watches the arrivals of one camera. Mutable; nothing here reads a clock."""

    def __init__(self) -> None:
        self._changes, self._why = 0, ""
        self._opened = False
        self._last_ns: int | None = None
        self._stamp_s = -math.inf
        self._intervals: deque[float] = deque(maxlen=31)
        self._recent: deque[tuple[int, float]] = deque()
        self._first: int | None = None
        self._least: tuple[int, float] | None = None
        self._base_s: float | None = None

    def opened(self) -> None:
        """Note that the camera was opened, for the first time or again."""
        if self._opened:
            self._changed("the camera was opened again")
        self._opened = True
        self._restart()

    def arrived(self, arrived_ns: int, stamp_s: float) -> Arrival:
        """Note an image with its timestamp (s; NaN where there is none)."""
        gap_s = math.nan if self._last_ns is None else (arrived_ns - self._last_ns) / 1e9
        self._last_ns = arrived_ns
        usual_s = sorted(self._intervals)[len(self._intervals) // 2] if self._intervals else GAP_S
        stalled = gap_s > max(GAP_S, GAP_INTERVALS * usual_s)
        if stalled:
            self._recent.clear()
            if self._base_s is None:
                self._changed(f"no image for {gap_s:.1f} s")
                self._first = self._least = None
        elif gap_s >= 0:
            self._intervals.append(gap_s)
        grown_s = self._grown(arrived_ns, stamp_s)
        return Arrival(arrived_ns, self._changes, self._why, grown_s)

    def _grown(self, arrived_ns: int, stamp_s: float) -> float:
        before, self._stamp_s = self._stamp_s, stamp_s
        if not (math.isfinite(stamp_s) and stamp_s > before):
            if self._base_s is not None and math.isfinite(before):
                self._changed("timestamps of the stream jumped")
            self._restart_stamps()
            return math.nan
        behind_s = arrived_ns / 1e9 - stamp_s
        self._recent.append((arrived_ns, behind_s))
        while self._recent[0][0] < arrived_ns - WINDOW_S * 1e9:
            self._recent.popleft()
        least_s = min(behind for _, behind in self._recent)
        if self._base_s is not None:
            return least_s - self._base_s
        self._check(arrived_ns, least_s)
        return math.nan if self._base_s is None else 0.0

    def _check(self, arrived_ns: int, least_s: float) -> None:
        """Find out whether timestamps advance like arrivals; start again where they do not."""
        if self._first is None:
            self._first = arrived_ns
        seconds = (arrived_ns - self._first) / 1e9
        if self._least is None:
            if seconds >= WINDOW_S:
                self._least = arrived_ns, least_s
            return
        seconds = (arrived_ns - self._least[0]) / 1e9
        if seconds < CHECKED_S:
            return
        if abs(least_s - self._least[1]) <= RATE_ERROR * seconds:
            self._base_s = least_s
        else:
            self._least = arrived_ns, least_s

    def _changed(self, why: str) -> None:
        self._changes, self._why = self._changes + 1, why

    def _restart(self) -> None:
        self._last_ns, self._stamp_s = None, -math.inf
        self._intervals.clear()
        self._restart_stamps()

    def _restart_stamps(self) -> None:
        self._recent.clear()
        self._first = self._least = self._base_s = None
