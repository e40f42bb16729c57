"""Figures of simulated flights in the loop."""

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop.loop import Flown, Located, Scenario, fly, spans, tilt_off_rad
from benchmarks.closed_loop.recorded import Demo
from benchmarks.closed_loop.replays import plain, stated
from benchmarks.fault_flights import FAR_M, FAR_STD
from benchmarks.record import Section, Table, number, quantiles, say

GNSS_S, BEFORE_S, AFTER_S = 60.0, 60.0, 60.0
"""With GNSS, then without it before a disturbance, and after it."""
SCENARIOS = ("gnss", "nothing", "fixes", "start", "shifted", "mirrored", "frozen")
LASTS_S = {"shifted": 40.0, "mirrored": 40.0, "frozen": 10.0}
HEADER = (
    *("scenario", "position median m", "95 %", "max", "position NEES", "velocity m/s", "95 %"),
    *("tilt deg", "fixes median m", "95 %", "NEES", "tilt correlation", "slope", "sent", "false"),
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
        *quantiles(far_m, 50, 95),
        number(float(far_m.max())),
        number(float(np.mean((far_m / claimed) ** 2))),
        *quantiles(mps, 50, 95),
        number(math.sqrt(float((tilts**2).sum(1).mean()))),
        *quantiles(errors, 50, 95),
        number(float(np.mean([view.nees for view in sent]))) if sent else "-",
        *by_tilt(sent),
        f"{len(sent) / len(views):.0%}" if views else "-",
        str(sum(view.is_wrong for view in sent)) if views else "-",
    ]


def measure(options: argparse.Namespace) -> Section:
    """All scenarios of a vehicle with a filter, or only some, each with each seed."""
    demo, rows = Demo.made(options.work), []
    for seed in options.seed:
        for name in options.only or SCENARIOS:
            flown = fly(
                scenario(name, options.minutes, options.send),
                demo,
                vehicle=options.vehicle,
                autopilot=options.filter,
                seed=seed,
                rule=plain if options.plain else stated,
            )
            rows.append(cells(flown))
            if len(options.seed) > 1:
                rows[-1][0] += f", seed {seed}"
            say(f"{' | '.join(rows[-1])} {flown.withheld}")
    notes = (
        f"{options.minutes:g} minutes without GNSS after {GNSS_S:g} s with it; disturbances begin "
        f"{BEFORE_S:g} s later; judged from 5 s after GNSS was cut on; nothing: no fixes",
        "position, velocity, tilt: errors of the autopilot, tilt as RMS; NEES: mean, 2 is right; "
        "fixes: those sent; tilt correlation, slope: of the errors of fixes with height times the "
        "tangent of the autopilot's error of tilt, ahead and right; false: sent, and more than "
        f"{FAR_M:g} m and {FAR_STD:g} stated deviations off",
    )
    title = f"{options.vehicle}, filter like {options.filter}'s, sent: {options.send}"
    return Section("Flights in the loop", [Table(title, HEADER, rows, notes)])
