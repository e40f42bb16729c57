"""The GNSS monitors of a flight: they are fed with views and GNSS, and their status is reported.

It uses one time base: the monotonic clock of a live flight, or the times of a recording.
"""

import contextlib
import logging
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from orthonav.core.flight.gnss import BIASES, FAULTS, GnssSample
from orthonav.core.flight.logged import gnss_message
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import CONFIDENT, MAP_STD_M, Fix, ViewResult
from orthonav.onboard.gnss.biases import Array, Biases, at_start
from orthonav.onboard.gnss.monitor import GnssMonitor, GnssState, GnssStatus, MapPosition

log = logging.getLogger(__name__)
DISPLACED = "map_displaced"
"""Reason in health: the learnt displacement is larger than that of a map as accurate as fixes
state, or GNSS was spoofed since the first flight over it."""
GnssText = tuple[int, str]
"""MAV_SEVERITY and at most 50 characters, for the operator."""


class GnssWatch:
    """Compares the GNSS receivers of a flight with the map. Mutable; for the flight's thread."""

    def __init__(
        self,
        frame: LocalFrame,
        solutions: deque[GnssSample],
        *,
        digest: str = "",
        known: Mapping[str, Biases] = MappingProxyType({}),
        reference: Biases | None = None,
        setup: str = "",
        recorded: bool = False,
        min_confidence: float = CONFIDENT,
        utc_ahead_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        """`frame`: plane of the map. `solutions`: those that arrived, or all of a recording, in
        order of their arrival. `digest`: of the map; `known`: biases by digest, the latest last.
        `reference`: of this flight, where it was interrupted. `setup`: identifies camera, mount and
        stated latency. `recorded`: times are those of the recording. `utc_ahead_ns`: what is added
        to times of solutions in the log. `log` gets every solution, as the message of a flight log.
        """
        self._frame, self._solutions, self._utc_ahead_ns = frame, solutions, utc_ahead_ns
        self.log: Callable[[int, bytes], None] = lambda time_ns, cdr: None
        self._digest, self._known = digest, dict(known)
        before = known if reference is None else {**known, digest: reference}
        self._start = at_start(known, digest, setup), at_start(before, digest, setup)
        self._recorded, self._least = recorded, min_confidence
        self._first = GnssMonitor(frame, *self._start)
        self._monitors: dict[int, GnssMonitor] = {}  # of the receivers that were heard
        self._shown: dict[int, GnssStatus] = {}
        self._last: GnssSample | None = None
        self._now_ns, self._has_failed = 0, False

    def view(self, result: ViewResult, exposed_ns: int) -> ViewResult:
        """Compare a view; the result with the GNSS position of its exposure as evidence."""
        now_ns = result.time_ns if self._recorded else exposed_ns
        with self._surviving("a view could not be compared with GNSS"):
            self._take(now_ns)
            outcome = result.outcome
            if isinstance(outcome, Fix):
                self._compare(outcome, result.state, now_ns)
                outcome = self._corrected(outcome)
            evidence = {**outcome.evidence, **self._evidence(now_ns)}
            return replace(result, outcome=replace(outcome, evidence=evidence))
        return result

    def tick(self, mono_ns: int) -> list[GnssText]:
        """Judge at a time of the monotonic clock; messages about changes since the last call."""
        texts: list[GnssText] = []
        with self._surviving("GNSS could not be judged"):
            if not self._recorded:
                self._take(mono_ns)
            for number, monitor in self._monitors.items():
                before = self._shown.get(number, GnssStatus())
                self._shown[number] = status = monitor.tick(self._now_ns)
                texts += _changes("GNSS" if number == 0 else f"GNSS {number + 1}", before, status)
        return texts

    @contextlib.contextmanager
    def _surviving(self, text: str) -> Iterator[None]:
        """Log an error, once as it may happen at every view: the flight needs no monitor."""
        try:
            yield
        except Exception:
            if not self._has_failed:
                log.exception("%s", text)
            self._has_failed = True

    def _compare(self, fix: Fix, state: str | None, now_ns: int) -> None:
        known = math.isfinite(fix.std_m + fix.heading_deg) and state in (None, "tracking")
        if known and fix.confidence >= self._least:
            velocity = fix.known_velocity_en_mps
            flown = None if velocity is None else np.array(velocity)
            agl_m = fix.agl_m if math.isfinite(fix.agl_m) else 0.0
            place = self._en_m(fix), fix.std_m, flown, fix.heading_deg, agl_m
            for monitor in self._monitors.values():
                monitor.position(MapPosition(now_ns, *place))

    def _corrected(self, fix: Fix) -> Fix:
        """By the displacement of the map, as far as it is known, where the fix includes one."""
        if not float(np.linalg.eigvalsh(fix.cov_en_m2)[0]) >= MAP_STD_M**2:
            return fix
        en_m, cov = self._first.undisturbed.displacement
        lat, lon = self._frame.latlon_from_en(self._en_m(fix) + en_m)
        moved = fix.with_covariance(fix.cov_en_m2 + cov - np.eye(2) * MAP_STD_M**2)
        return replace(moved, lat_deg=float(lat), lon_deg=float(lon))

    def _en_m(self, place: Fix | GnssSample) -> Array:
        return np.asarray(self._frame.en_from_latlon(place.lat_deg, place.lon_deg))

    def reasons(self, now_ns: int = 0) -> tuple[str, ...]:
        """Reasons of health by the last judgements."""
        found = [monitor.status.reason for monitor in self._monitors.values()]
        if not self._first.learnt.is_plausible:
            found.append(DISPLACED)
        return tuple(dict.fromkeys(each for each in found if each))

    @property
    def code(self) -> int:
        """Of the first reason, see `FAULTS`; 0 without one."""
        found = [monitor.status.reason for monitor in self._monitors.values()]
        return next((FAULTS.index(each) + 1 for each in found if each), 0)

    @property
    def difference_m(self) -> float:
        """Recent distance from the map to the first receiver; NaN where not known."""
        return math.hypot(*self._first.status.difference_en_m)

    def maps(self) -> dict[str, Any]:
        """Biases for the state file: those of this map, learnt further, after the others."""
        made = {name: each.to_plain() for name, each in self._known.items() if name != self._digest}
        learnt, reference = self._first.learnt, self._first.reference
        if self._digest and learnt.agreed_s > 0:
            made[self._digest] = {**learnt.to_plain(), "reference": reference.to_plain()}
        return made

    def plain(self) -> list[dict[str, Any]]:
        """The status of each receiver for strict JSON."""
        return [self._status(number, each) for number, each in sorted(self._monitors.items())]

    def _status(self, number: int, monitor: GnssMonitor) -> dict[str, Any]:
        status = monitor.status
        length, bearing = _polar(status.difference_en_m)
        known = math.isfinite(length)
        for_s = round((self._now_ns - status.since_ns) / 1e9, 1) if status.since_ns else None
        return {
            "receiver": number,
            "state": status.state.value,
            "for_s": for_s,
            "fault": status.fault.value if status.fault else None,
            "difference_m": round(length, 2) if known else None,
            "bearing_deg": round(bearing, 1) if known else None,
            "agreed_s": round(monitor.learnt.agreed_s),
        }

    def _take(self, now_ns: int) -> None:
        self._now_ns = now_ns if self._recorded else max(self._now_ns, now_ns)
        waiting = self._solutions
        while waiting and (not self._recorded or waiting[0].arrived_ns <= now_ns):
            sample = waiting.popleft()
            number = sample.receiver
            if number not in self._monitors:
                made = GnssMonitor(self._frame, *self._start) if number else self._first
                self._monitors[number] = made
            self._monitors[number].sample(sample)
            if number == 0:
                self._last = sample
            time_ns = sample.time_ns + self._utc_ahead_ns()
            with contextlib.suppress(ValueError):  # a position that is not finite
                self.log(time_ns, gnss_message(sample, time_ns))

    def _evidence(self, now_ns: int) -> dict[str, float]:
        """Position of the first receiver at an exposure, by its velocity, and the fault's code."""
        made = {"gnss_fault": float(self.code)}
        learnt, last = self._first.learnt, self._last
        if learnt.agreed_s > 0:  # in the units of `BIASES`
            units = np.array([1.0, 1.0, math.degrees(1.0), math.degrees(1.0), 1e3])
            shown = np.round(np.transpose([learnt.mean * units, learnt.stds * units]), 3)
            made |= dict(zip(np.ravel(BIASES).tolist(), shown.ravel().tolist(), strict=True))
        seconds = math.inf if last is None else (now_ns - last.time_ns) / 1e9
        if last is not None and last.is_valid and abs(seconds) <= 1.0:
            en_m = self._en_m(last) + seconds * np.array(last.vel_en_mps or (0.0, 0.0))
            lat, lon = map(float, self._frame.latlon_from_en(en_m))
            made |= {"gnss_lat_deg": lat, "gnss_lon_deg": lon, "gnss_std_m": last.std_m}
        return made


def _changes(name: str, before: GnssStatus, now: GnssStatus) -> list[GnssText]:
    """A text about an alarm that began or changed, or its end; none without."""
    changed = (before.state, before.fault) != (now.state, now.fault)
    if now.state is GnssState.ALARM and changed:
        kind = now.fault.value.removeprefix("gnss_") if now.fault else "fault"
        return [(2, f"orthonav {name} {kind}{_size(now.fault_en_m)}")]
    if now.state is GnssState.GOOD and before.state in (GnssState.ALARM, GnssState.RETURNING):
        return [(5, f"orthonav {name} agrees, jump{_size(now.difference_en_m)}")]
    return []


def _size(en_m: tuple[float, float]) -> str:
    length, bearing = _polar(en_m)
    return f" {length:.0f} m to {bearing:03.0f} deg" if math.isfinite(length) else ""


def _polar(en_m: tuple[float, float]) -> tuple[float, float]:
    """Length and bearing (degrees clockwise from north); NaN where not known."""
    east, north = en_m
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360
