"""`python -m benchmarks.gnss_watch [--hours 10] [--trials 20]`: the GNSS monitor by itself.

Simulated receivers against simulated positions of a map, both with correlated errors: false alarms
over hours, the delay until each fault is named, and the biases learnt of map, mount and latency. No
images are involved.
"""

import argparse
import math
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import Section, Table, number, run, say
from orthonav.core.flight.gnss import Fault, GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.simulate.motion import gauss_markov
from orthonav.ground.simulate.receiver import (
    ERRORS,
    RATE_HZ,
    GnssTrack,
    receiver_of,
    samples_of,
    solutions,
)
from orthonav.onboard.gnss.biases import Biases, design
from orthonav.onboard.gnss.monitor import GnssMonitor, GnssState, GnssStatus, MapPosition

FRAME = LocalFrame(48.0, 2.0)
SPEED_MPS, LEG_M, TURN_RADIUS_M = 20.0, 2000.0, 100.0
ROLL_S = 3
"""Time to roll into a turn."""
FAULT_AT_S = 900.0
LONGEST_S, SETTLED_S = 900.0, 10.0
"""How long a fault is watched, and from its alarm to its last name."""
PITCH_DEG, LATE_S, MINUTES = 2.0, 0.3, (15, 30, 60, 90)
"""Error of the mount and latency that are learnt besides the displacement; when they are read."""
SLOW_DRAG_S = 4 * 3600.0
PROCESSING_NS = 10**8
"""Time from exposure to the map's position."""
FAULTS = {
    "step of 30 m": "step:metres=30",
    "step of 30 m within 3 s, velocity too": "step:metres=30,over_s=3",
    "step of 20 m": "step:metres=20",
    "drag-off of 2 m/s": "drag:mps=2",
    "drag-off of 1 m/s": "drag:mps=1",
    "drag-off of 0.5 m/s": "drag:mps=0.5",
    "drag-off of 0.2 m/s": "drag:mps=0.2",
    "drag-off of 0.1 m/s": "drag:mps=0.1",
    "drift of 0.5 m/s": "drift:mps=0.5",
    "frozen position": "frozen",
    "frozen, stale timestamps": "frozen:stale=1",
    "jumping by 40 m": "jumping:metres=40",
    "jumping by 20 m": "jumping:metres=20",
    "no fix": "jam",
    "no messages": "jam:silent=1",
}
"""Faults by name, as for `orthonav simulate --receiver`."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class MapErrors:
    """Errors of the simulated map positions; each position states the root of their squares.

    `mount_m`: constant in the aircraft at `agl_m`, as from a tilted mount. `local_m`,
    `local_tau_s`: slowly varying. `white_m`: from view to view. `displaced_m`: length of the
    constant displacement. `gaps_per_hour`: stretches of 10 to 90 s without confident positions.
    `outlier_share`: fraction of confident positions that are 20 to 150 m off. `pitch_deg`: error of
    the reported pitch, which the position does not state. `late_s`: the images are older than
    assumed.
    """

    mount_m: float = 2.0
    local_m: float = 2.5
    local_tau_s: float = 40.0
    white_m: float = 1.0
    displaced_m: float = 40.0
    gaps_per_hour: float = 20.0
    outlier_share: float = 3e-4
    agl_m: float = 300.0
    pitch_deg: float = 0.0
    late_s: float = 0.0

    @property
    def displaced_en_m(self) -> Array:
        """True minus map position (2,)."""
        return self.displaced_m * np.array([0.6, -0.8])

    @property
    def std_m(self) -> float:
        """Standard deviation per axis that a position states, with the track's floor of 3 m."""
        return math.sqrt(self.mount_m**2 / 2 + self.local_m**2 + self.white_m**2 + 9.0)


MAPS = {
    "usual": MapErrors(),
    "poor": MapErrors(mount_m=4.0, local_m=4.0, white_m=2.0, displaced_m=60.0),
    "high": MapErrors(mount_m=15.0, local_m=6.0, white_m=3.0, displaced_m=20.0, agl_m=2000.0),
}
"""Errors by name: at 300 m, with a worse mount and map, and at 2,000 m."""


@dataclass(frozen=True, eq=False)
class FlownPath:
    """True path: `times_s` (N,), `en_m` (N, 2), `heading_rad` (N,), `speed_mps` (N,)."""

    times_s: Array
    en_m: Array
    heading_rad: Array
    speed_mps: Array

    @property
    def vel_en_mps(self) -> Array:
        """Velocity (N, 2)."""
        ahead = np.stack([np.sin(self.heading_rad), np.cos(self.heading_rad)], axis=1)
        return np.asarray(self.speed_mps[:, None] * ahead)

    def bank_tangent(self, late_s: float) -> Array:
        """Tangent (N,) of the bank angle, to the right, `late_s` before each time."""
        rate = np.gradient(np.unwrap(self.heading_rad), self.times_s)
        tangent = rate * self.speed_mps / 9.81
        return np.asarray(np.interp(self.times_s - late_s, self.times_s, tangent))


def lawnmower(seconds: float, speeds_mps: Sequence[float] = (SPEED_MPS,)) -> FlownPath:
    """Parallel legs with half turns, one position a second; each speed for two legs in turn."""
    lap_m = LEG_M + math.pi * TURN_RADIUS_M
    times, along, speeds = np.arange(0.0, seconds), [0.0], []
    for _ in times:
        speeds.append(speeds_mps[int(along[-1] // (2 * lap_m)) % len(speeds_mps)])
        along.append(along[-1] + speeds[-1])
    number, rest = np.divmod(np.array(along[:-1]), lap_m)
    turning = np.clip(rest - LEG_M, 0, None) / TURN_RADIUS_M
    side = np.where(number % 2 == 0, 1.0, -1.0)
    heading = np.where(number % 2 == 0, 0.0, math.pi) + side * turning
    heading = np.unwrap(heading)
    heading = np.convolve(np.pad(heading, ROLL_S // 2, "edge"), np.ones(ROLL_S) / ROLL_S, "valid")
    path = FlownPath(times, np.zeros((len(times), 2)), heading, np.array(speeds))
    places = np.cumsum(path.vel_en_mps, axis=0)
    return replace(path, en_m=places - places[0])


def map_positions(
    path: FlownPath, errors: MapErrors, rng: np.random.Generator
) -> list[MapPosition]:
    """Confident positions along a path, with errors."""
    count = len(path.times_s)
    step_s = float(path.times_s[1] - path.times_s[0])
    body = rng.normal(0, errors.mount_m / math.sqrt(2), 2)
    cos, sin = np.cos(path.heading_rad), np.sin(path.heading_rad)
    mount = np.stack([cos * body[0] + sin * body[1], cos * body[1] - sin * body[0]], axis=1)
    off = mount + errors.local_m * gauss_markov(step_s / errors.local_tau_s, count, rng)
    off += rng.normal(0, errors.white_m, (count, 2)) - errors.displaced_en_m
    ahead, right = np.stack([sin, cos], axis=1), np.stack([cos, -sin], axis=1)
    off += errors.agl_m * math.tan(math.radians(errors.pitch_deg)) * ahead
    rolled = path.bank_tangent(0.0) - path.bank_tangent(errors.late_s)
    off += errors.agl_m * rolled[:, None] * right - errors.late_s * path.vel_en_mps
    wrong = rng.random(count) < errors.outlier_share
    off[wrong] += rng.uniform(20, 150, (int(wrong.sum()), 1)) * np.array([[0.6, 0.8]])
    confident = np.ones(count, dtype=bool)
    hours = (path.times_s[-1] - path.times_s[0]) / 3600
    for _ in range(rng.poisson(errors.gaps_per_hour * hours)):
        begin = rng.uniform(path.times_s[0], path.times_s[-1])
        confident &= (path.times_s < begin) | (path.times_s > begin + rng.uniform(10, 90))
    velocity = path.vel_en_mps + 0.3 * gauss_markov(step_s / 30.0, count, rng)
    return [
        MapPosition(
            round(path.times_s[i] * 1e9),
            path.en_m[i] + off[i],
            errors.std_m,
            velocity[i],
            math.degrees(path.heading_rad[i]) % 360,
            errors.agl_m,
        )
        for i in np.flatnonzero(confident)
    ]


def fed(
    monitor: GnssMonitor, solved: GnssTrack, positions: Sequence[MapPosition]
) -> Iterator[tuple[float, GnssStatus]]:
    """Feed a monitor in the order of arrival, positions 0.1 s after their exposure.

    Time and status after each event. Silence is noticed by a tick with each position.
    """
    events: list[tuple[int, GnssSample | MapPosition]] = [
        (sample.arrived_ns, sample) for sample in samples_of(solved, FRAME)
    ]
    events += [(each.time_ns + PROCESSING_NS, each) for each in positions]
    events.sort(key=lambda event: event[0])
    for now_ns, event in events:
        if isinstance(event, GnssSample):
            monitor.sample(event)
        else:
            monitor.position(event)
            monitor.tick(now_ns)
        yield now_ns / 1e9, monitor.status


def changes(statuses: Iterable[tuple[float, GnssStatus]]) -> Iterator[tuple[float, GnssStatus]]:
    """The first of each stretch of equal state and fault."""
    before = GnssStatus()
    for at_s, now in statuses:
        if (now.state, now.fault) != (before.state, before.fault):
            before = now
            yield at_s, now


def false_alarms(
    hours: float, seed: int, receiver: str, errors: MapErrors, *, rate_hz: float = RATE_HZ
) -> tuple[list[tuple[float, GnssStatus]], GnssMonitor]:
    """Alarms (time, status) of a receiver without a fault, and the monitor at the end."""
    rng = np.random.default_rng([seed, 0])
    path = lawnmower(hours * 3600)
    positions = map_positions(path, errors, rng)
    solved = solutions(receiver_of(receiver), path.times_s, path.en_m, rng, rate_hz)
    monitor = GnssMonitor(FRAME)
    seen = changes(fed(monitor, solved, positions))
    return [(at_s, status) for at_s, status in seen if status.state is GnssState.ALARM], monitor


def delay(
    text: str, seed: int, errors: MapErrors, *, at_s: float = FAULT_AT_S, for_s: float = LONGEST_S
) -> tuple[float, float, Fault | None]:
    """Seconds from a fault to its alarm, to its last name, and that name; NaN without an alarm.

    The last name is that of 10 s after the alarm: a sudden step is a jump at first.
    The fault begins at `at_s` or up to 250 s later, and is watched `for_s`.
    """
    rng = np.random.default_rng([seed, 1])
    at_s += rng.uniform(0, 250)
    path = lawnmower(at_s + for_s)
    positions = map_positions(path, replace(errors, gaps_per_hour=0.0), rng)
    name, _, rest = text.partition(":")
    values = [rest, f"at_s={at_s}"]
    if name in ("step", "drag", "drift"):
        values.append(f"bearing_deg={rng.uniform(0, 360)}")
    receiver = receiver_of(f"{name}:{','.join(filter(None, values))}")
    solved = solutions(receiver, path.times_s, path.en_m, rng)
    found: list[tuple[float, Fault | None]] = []
    for now_s, status in changes(fed(GnssMonitor(FRAME), solved, positions)):
        if status.state is GnssState.ALARM and now_s >= at_s:
            found.append((now_s - at_s, status.fault))
        if found and now_s > at_s + found[0][0] + SETTLED_S:
            break
    within = [each for each in found if each[0] <= found[0][0] + SETTLED_S]
    return (found[0][0], *within[-1]) if found else (math.nan, math.nan, None)


def false_alarm_table(hours: float) -> Table:
    rows: list[list[str]] = []
    for receiver in ("good", "good:std_m=5"):
        for name, errors in MAPS.items():
            alarms, last = false_alarms(hours, len(rows), receiver, errors)
            learnt = last.learnt
            off_m = math.hypot(*(learnt.en_m - errors.displaced_en_m))
            figures = [number(hours), str(len(alarms)), f"{off_m:.1f}", f"{learnt.std_m:.1f}"]
            rows.append([f"{receiver_of(receiver).std_m:g} m", name, *figures])
            say(" | ".join(rows[-1]))
    header = ["GNSS error", "map", "hours", "false alarms", "displacement off, m", "stated, m"]
    return Table("No fault", header, rows)


def delay_table(trials: int) -> Table:
    rows = []
    for name, text in FAULTS.items():
        found = [delay(text, seed, MAPS["usual"]) for seed in range(trials)]
        delays = np.array([each[0] for each in found])
        missed = int(np.isnan(delays).sum())
        names = Counter(each[2].value if each[2] else "none" for each in found)
        shown = ", ".join(f"{key} {count}" for key, count in names.most_common())
        median, most = (f"{f(delays):.1f}" for f in (np.nanmedian, np.nanmax))
        rows.append([name, str(trials), str(missed), median, most, shown])
        say(" | ".join(rows[-1]))
    header = ["fault", "trials", "missed", "median s", "worst s", "name after 10 s"]
    return Table("Delay until a fault is named", header, rows)


def recovered(
    seed: int, speeds_mps: Sequence[float], minutes: Sequence[int]
) -> list[tuple[Array, Biases]]:
    """Errors (5,) of the learnt biases and the biases, after each of the ascending `minutes`."""
    rng = np.random.default_rng([seed, 2])
    path = lawnmower(60.0 * minutes[-1] + 2, speeds_mps)
    late_s = LATE_S + ERRORS.latency_s
    errors = replace(MAPS["usual"], mount_m=0.0, pitch_deg=PITCH_DEG, late_s=late_s)
    positions = map_positions(path, errors, rng)
    solved = solutions(receiver_of("good"), path.times_s, path.en_m, rng, 1.0)
    true = np.array([*errors.displaced_en_m, math.radians(PITCH_DEG), 0.0, LATE_S])
    monitor, left, found = GnssMonitor(FRAME), list(minutes), []
    for now_s, _ in fed(monitor, solved, positions):
        if left and now_s >= 60.0 * left[0]:
            left.pop(0)
            found.append((monitor.learnt.mean - true, monitor.learnt))
    return found


def recovery_table(trials: int) -> Table:
    """Errors of the learnt biases over time: root mean square, and as stated."""
    scale = np.array([1.0, 1.0, math.degrees(1.0), math.degrees(1.0), 1e3])
    rows = []
    for speeds in ((15.0, 25.0), (SPEED_MPS,)):
        leg = design(0.0, MAPS["usual"].agl_m, np.array([0.0, SPEED_MPS]))
        runs = [recovered(seed, speeds, MINUTES) for seed in range(trials)]
        for i, minutes in enumerate(MINUTES):
            off = np.array([run[i][0] for run in runs])
            learnt = [run[i][1] for run in runs]
            rms = np.sqrt((off**2).mean(axis=0)) * scale
            stated = np.mean([each.stds for each in learnt], axis=0) * scale
            moved = math.sqrt(((off @ leg.T) ** 2).sum(axis=1).mean())
            spread = np.mean([math.sqrt(np.trace(leg @ each.cov @ leg.T)) for each in learnt])
            displaced = math.hypot(rms[0], rms[1]), math.hypot(stated[0], stated[1])
            pairs = [displaced, (rms[2], stated[2]), (rms[4], stated[4]), (moved, spread)]
            shown = [f"{error:.3g} / {std:.3g}" for error, std in pairs]
            rows.append([" and ".join(f"{v:g}" for v in speeds), str(minutes), *shown])
            say(" | ".join(rows[-1]))
    header = ["speeds, m/s", "minutes", "displacement, m", "pitch, deg", "latency, ms"]
    title = f"Learning {MAPS['usual'].displaced_m:g} m, {PITCH_DEG:g} deg and {LATE_S:g} s"
    return Table(f"{title}: error / stated", [*header, "their sum, m"], rows)


def slow_drag(mps: float, seed: int) -> tuple[float, float, float]:
    """Seconds until a drag-off after an hour of agreement is named, the most by which the learnt
    displacement followed it, and its error after the alarm; NaN without an alarm."""
    rng = np.random.default_rng([seed, 3])
    errors = MAPS["usual"]
    path = lawnmower(3600.0 + SLOW_DRAG_S)
    positions = map_positions(path, errors, rng)
    text = f"drag:mps={mps},at_s=3600,bearing_deg={rng.uniform(0, 360)}"
    solved = solutions(receiver_of(text), path.times_s, path.en_m, rng, 1.0)
    monitor, most = GnssMonitor(FRAME), 0.0
    for now_s, status in fed(monitor, solved, positions):
        off_m = math.hypot(*(monitor.learnt.en_m - errors.displaced_en_m))
        if now_s > 3600 and status.state is GnssState.ALARM:
            return now_s - 3600, most, off_m
        most = max(most, off_m) if now_s > 3600 else 0.0
    return math.nan, most, off_m


def slow_drag_table(trials: int) -> Table:
    """Drag-offs that are slow enough to be learnt."""
    rows = []
    for mps in (0.1, 0.05, 0.02, 0.01, 0.005):
        found = np.array([slow_drag(mps, seed) for seed in range(trials)])
        missed = int(np.isnan(found[:, 0]).sum())
        late, most, left = (f"{value:.1f}" for value in np.nanmax(found, axis=0))
        moved = f"{np.nanmax(found[:, 0]) * mps:.0f}"
        rows.append([f"{mps:g} m/s", str(trials), str(missed), late, moved, most, left])
        say(" | ".join(rows[-1]))
    header = ["drag-off", "trials", "missed", "worst s", "GNSS moved, m", "learnt, m", "left, m"]
    return Table("Slow drag-offs after an hour of agreement", header, rows)


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hours", type=float, default=10.0, help="of each flight without a fault")
    parser.add_argument("--trials", type=int, default=20, help="of each fault")


def measure(options: argparse.Namespace) -> Section:
    if options.quick:
        return Section("GNSS watch", [delay_table(1), false_alarm_table(0.1)])
    trials = options.trials
    tables = [delay_table(trials), recovery_table(trials), slow_drag_table(min(trials, 4))]
    return Section("GNSS watch", [*tables, false_alarm_table(options.hours)])


if __name__ == "__main__":
    sys.exit(run(measure, add))
