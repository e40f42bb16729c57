"""The GNSS monitors of a flight: they are fed with views and GNSS, and their status is reported.

It uses one time base: the monotonic clock of a live flight, or the times of a recording.
"""

import contextlib
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from orthonav.core.flight.gnss import BIASES, GnssSample
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
        start = before = at_start(known, digest, setup)
        if reference is not None:
            before = at_start({**known, digest: reference}, digest, setup)
        self._made = partial(GnssMonitor, frame, start, before)
        self._recorded, self._least = recorded, min_confidence
        self._first = self._made()
        self._monitors: dict[int, GnssMonitor] = {}  # of the receivers that were heard
        self._shown: dict[int, GnssStatus] = {}
        self._last: GnssSample | None = None
        self._now_ns, self._has_failed = 0, False

    def view(self, result: ViewResult, exposed_ns: int) -> ViewResult:
        """Compare a view; the result with the GNSS position of its exposure as evidence."""
        now_ns = result.time_ns if self._recorded else exposed_ns
        try:
            return self._compared(result, now_ns)
        except Exception:  # the flight does not depend on the monitor
            self._failed("a view could not be compared with GNSS")
            return result

    def _compared(self, result: ViewResult, now_ns: int) -> ViewResult:
        self._take(now_ns)
        fix = result.outcome
        if isinstance(fix, Fix) and self._is_confident(fix, result.state):
            position = self._position(fix, now_ns)
            for monitor in self._monitors.values():
                monitor.position(position)
        if isinstance(fix, Fix):
            fix = self._corrected(fix)
        evidence = {**fix.evidence, **self._evidence(now_ns)}
        return replace(result, outcome=replace(fix, evidence=evidence))

    def _corrected(self, fix: Fix) -> Fix:
        """By the displacement of the map, as far as it is known, where the fix includes one."""
        if not float(np.linalg.eigvalsh(fix.cov_en_m2)[0]) >= MAP_STD_M**2:
            return fix
        en_m, cov = self._first.undisturbed.displacement
        place_m = np.asarray(self._frame.en_from_latlon(fix.lat_deg, fix.lon_deg)) + en_m
        lat, lon = self._frame.latlon_from_en(place_m)
        moved = fix.with_covariance(fix.cov_en_m2 + cov - np.eye(2) * MAP_STD_M**2)
        return replace(moved, lat_deg=float(lat), lon_deg=float(lon))

    def tick(self, mono_ns: int) -> list[GnssText]:
        """Judge at a time of the monotonic clock; messages about changes since the last call."""
        try:
            return self._ticked(mono_ns)
        except Exception:  # the flight does not depend on the monitor
            self._failed("GNSS could not be judged")
            return []

    def _failed(self, text: str) -> None:
        if not self._has_failed:  # once: it may happen at every view
            log.exception("%s", text)
        self._has_failed = True

    def _ticked(self, mono_ns: int) -> list[GnssText]:
        if not self._recorded:
            self._take(mono_ns)
        texts = []
        for number, monitor in self._monitors.items():
            status = monitor.tick(self._now_ns)
            before = self._shown.get(number, GnssStatus())
            self._shown[number] = status
            name = "GNSS" if number == 0 else f"GNSS {number + 1}"
            text = _change(name, before, status)
            if text is not None:
                texts.append(text)
        return texts

    def reasons(self, now_ns: int = 0) -> tuple[str, ...]:
        """Reasons of health by the last judgements."""
        found = [monitor.status.reason for monitor in self._monitors.values()]
        if not self._first.learnt.is_plausible:
            found.append(DISPLACED)
        return tuple(dict.fromkeys(each for each in found if each))

    @property
    def code(self) -> int:
        return next((m.status.code for m in self._monitors.values() if m.status.code), 0)

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
        return [
            _plain(number, each.status, self._now_ns) | {"agreed_s": round(each.learnt.agreed_s)}
            for number, each in sorted(self._monitors.items())
        ]

    def _take(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns) if not self._recorded else now_ns
        waiting = self._solutions
        while waiting and (not self._recorded or waiting[0].arrived_ns <= now_ns):
            sample = waiting.popleft()
            if sample.receiver not in self._monitors:
                self._monitors[sample.receiver] = self._made() if sample.receiver else self._first
            self._monitors[sample.receiver].sample(sample)
            if sample.receiver == 0:
                self._last = sample
            time_ns = sample.time_ns + self._utc_ahead_ns()
            with contextlib.suppress(ValueError):  # a position that is not finite
                self.log(time_ns, gnss_message(sample, time_ns))

    def _is_confident(self, fix: Fix, state: str | None) -> bool:
        known = math.isfinite(fix.std_m + fix.heading_deg)
        return known and fix.confidence >= self._least and state in (None, "tracking")

    def _position(self, fix: Fix, now_ns: int) -> MapPosition:
        return MapPosition(
            now_ns,
            np.asarray(self._frame.en_from_latlon(fix.lat_deg, fix.lon_deg)),
            fix.std_m,
            _velocity(fix),
            fix.heading_deg,
            fix.agl_m if math.isfinite(fix.agl_m) else 0.0,
        )

    def _evidence(self, now_ns: int) -> dict[str, float]:
        """Position of the first receiver at an exposure, by its velocity, and the fault's code."""
        made = {"gnss_fault": float(self.code)}
        if self._first.learnt.agreed_s > 0:
            made |= _bias_evidence(self._first.learnt)
        last = self._last
        if last is None or not last.is_valid:
            return made
        seconds = (now_ns - last.time_ns) / 1e9
        if abs(seconds) > 1.0:
            return made
        en_m = np.asarray(self._frame.en_from_latlon(last.lat_deg, last.lon_deg))
        en_m = en_m + seconds * np.array(last.vel_en_mps or (0.0, 0.0))
        lat, lon = self._frame.latlon_from_en(en_m)
        return made | {
            "gnss_lat_deg": float(lat),
            "gnss_lon_deg": float(lon),
            "gnss_std_m": last.std_m,
        }


def _velocity(fix: Fix) -> Array | None:
    """Velocity (2,) of the track, east and north; None where it is not known."""
    made = np.array([fix.evidence.get(f"vel_{n}_mps", math.nan) for n in ("east", "north")])
    return made if np.isfinite(made).all() else None


def _change(name: str, before: GnssStatus, now: GnssStatus) -> GnssText | None:
    changed = (before.state, before.fault) != (now.state, now.fault)
    if now.state is GnssState.ALARM and changed:
        kind = now.fault.value.removeprefix("gnss_") if now.fault else "fault"
        return 2, f"orthonav {name} {kind}{_size(now.fault_en_m)}"
    if now.state is GnssState.GOOD and before.state in (GnssState.ALARM, GnssState.RETURNING):
        return 5, f"orthonav {name} agrees, jump{_size(now.difference_en_m)}"
    return None


def _size(en_m: tuple[float, float]) -> str:
    length, bearing = _polar(en_m)
    return f" {length:.0f} m to {bearing:03.0f} deg" if math.isfinite(length) else ""


def _polar(en_m: tuple[float, float]) -> tuple[float, float]:
    """Length and bearing (degrees clockwise from north); NaN where not known."""
    east, north = en_m
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360


def _plain(number: int, status: GnssStatus, now_ns: int) -> dict[str, Any]:
    length, bearing = _polar(status.difference_en_m)
    known = math.isfinite(length)
    return {
        "receiver": number,
        "state": status.state.value,
        "for_s": round((now_ns - status.since_ns) / 1e9, 1) if status.since_ns else None,
        "fault": status.fault.value if status.fault else None,
        "difference_m": round(length, 2) if known else None,
        "bearing_deg": round(bearing, 1) if known else None,
    }


def _bias_evidence(learnt: Biases) -> dict[str, float]:
    """Each bias and its standard deviation, in the units of `BIASES`."""
    scale = np.array([1.0, 1.0, math.degrees(1.0), math.degrees(1.0), 1e3])
    made: dict[str, float] = {}
    for names, values in zip(BIASES, np.transpose([learnt.mean, learnt.stds]), strict=True):
        shown = np.round(values * scale[len(made) // 2], 3).tolist()
        made |= dict(zip(names, shown, strict=True))
    return made
