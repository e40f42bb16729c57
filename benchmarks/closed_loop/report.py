"""Figures of simulated flights in the loop."""

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop.ground import Demo
from benchmarks.closed_loop.loop import Flown, Located, Scenario, fly, spans, tilt_off_rad
from benchmarks.closed_loop.replays import Rule
from benchmarks.fault_flights import FAR_M, FAR_STD
from benchmarks.record import Section, Table, number

GNSS_S, BEFORE_S, AFTER_S = 60.0, 60.0, 60.0
"""With GNSS, then without it before a disturbance, and after it."""
SCENARIOS = ("gnss", "nothing", "fixes", "start", "shifted", "mirrored", "frozen")
LASTS_S = {"shifted": 40.0, "mirrored": 40.0, "frozen": 10.0}
HEADER = (
    *("scenario", "position median m", "95 %", "max", "position NEES", "velocity m/s", "95 %"),
    *("tilt deg", "fixes median m", "95 %", "NEES", "tilt correlation", "slope", "sent", "wrong"),
)
Array = NDArray[np.float64]


def scenario(name: str, minutes: float, send: str) -> Scenario:
    """A scenario of `SCENARIOS`; `minutes` without GNSS, unless it has a disturbance."""
    alone_s = 60 * minutes
    whole = Scenario(name, GNSS_S + alone_s, GNSS_S, send)
    if name == "gnss":
        return replace(whole, gnss_s=whole.seconds, send=None)
    if name == "nothing":
        return replace(whole, send=None)
    if name == "start":
        return replace(whole, seconds=min(alone_s, 240.0), gnss_s=0.0)
    if name == "fixes":
        return whole
    lasts_s = LASTS_S[name]
    begin_s = GNSS_S + BEFORE_S
    return Scenario(name, begin_s + lasts_s + AFTER_S, GNSS_S, send, name, begin_s, lasts_s)


def _median_95(values: Array) -> list[str]:
    if not len(values):
        return ["-", "-"]
    return [number(float(each)) for each in np.percentile(values, [50, 95])]


def by_tilt(views: Sequence[Located]) -> list[str]:
    """Correlations, ahead and right, of the errors of fixes with those that the error of the
    stated tilt makes, and the slopes."""
    if len(views) < 10:
        return ["-", "-"]
    errors = np.array([view.error_m for view in views]).T
    tilts = np.array([view.tilt_off_m for view in views]).T
    spreads = [np.cov(tilt, error) for tilt, error in zip(tilts, errors, strict=True)]
    alike = [each[0, 1] / math.sqrt(each[0, 0] * each[1, 1]) for each in spreads]
    slopes = [each[0, 1] / each[0, 0] for each in spreads]
    return [", ".join(f"{value:.2f}" for value in values) for values in (alike, slopes)]


def cells(flown: Flown) -> list[str]:
    """A row of the table."""
    samples, views = spans(flown)
    off = np.array([each.estimate.position - each.truth.position for each in samples])
    far_m = np.hypot(*off[:, :2].T)
    claimed = np.array([each.claimed_m for each in samples])
    mps = [np.hypot(*(each.estimate.velocity - each.truth.velocity)[:2]) for each in samples]
    tilts = np.degrees([tilt_off_rad(each.truth, each.estimate) for each in samples])
    sent = [view for view in views if view.sent]
    errors = np.array([np.hypot(*view.error_m) for view in sent])
    return [
        flown.scenario.name,
        *_median_95(far_m),
        number(float(far_m.max())),
        number(float(np.mean((far_m / claimed) ** 2))),
        *_median_95(np.array(mps)),
        number(math.sqrt(float((tilts**2).sum(1).mean()))),
        *_median_95(errors),
        number(float(np.mean([view.nees for view in sent]))) if sent else "-",
        *by_tilt(sent),
        f"{len(sent) / len(views):.0%}" if views else "-",
        str(sum(view.is_wrong for view in sent)) if views else "-",
    ]


def measure(
    work: Path,
    *,
    vehicle: str,
    autopilot: str,
    send: str,
    minutes: float,
    seeds: Sequence[int],
    rule: Rule,
    only: Sequence[str] = SCENARIOS,
) -> Section:
    """All scenarios of a vehicle with a filter, or `only` some, each with each seed."""
    demo, rows = Demo.made(work), []
    for seed in seeds:
        for name in only:
            begin = time.perf_counter()
            flown = fly(
                scenario(name, minutes, send),
                demo,
                vehicle=vehicle,
                autopilot=autopilot,
                seed=seed,
                rule=rule,
            )
            rows.append(cells(flown))
            if len(seeds) > 1:
                rows[-1][0] += f", seed {seed}"
            wall_s, withheld = time.perf_counter() - begin, flown.withheld
            print(" | ".join(rows[-1]), f"{wall_s:.0f} s", withheld, file=sys.stderr, flush=True)
    notes = (
        f"{minutes:g} minutes without GNSS after {GNSS_S:g} s with it; the disturbances begin "
        f"{BEFORE_S:g} s later; judged from 5 s after GNSS was cut on; nothing: no fixes",
        "position, velocity, tilt: errors of the autopilot, tilt as RMS; NEES: mean, 2 is right; "
        "fixes: those sent, NEES by their own covariance",
        "tilt correlation, slope: of the errors of fixes with height times the tangent of the "
        "autopilot's error of tilt, ahead and right",
        f"wrong: sent, and more than {FAR_M:g} m and {FAR_STD:g} stated deviations off",
    )
    title = f"{vehicle}, filter like {autopilot}'s, sent: {send}"
    return Section("Flights in the loop", [Table(title, HEADER, rows, notes)])
