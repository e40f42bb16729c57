"""A flight in the loop: true motion, instruments, filter, guidance, camera, orthonav, and back."""

import argparse
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop.inertial import FILTERS, STATES, Filter
from benchmarks.closed_loop.physics import (
    CALIBRATED,
    CONSUMER,
    STEP_S,
    VEHICLES,
    Grade,
    Instruments,
    Motion,
    Vehicle,
    Wind,
    about,
    euler_rad,
    increments,
)
from benchmarks.closed_loop.replays import CAMERA, Area, Grey, stated
from benchmarks.fault_flights import FAR_M, FAR_STD
from benchmarks.record import Section, Table, number, quantiles, say
from orthonav.core.flight.gnss import GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import (
    MAP_STD_M,
    Fix,
    NoFix,
    Prior,
    Telemetry,
    View,
    ViewResult,
    error_ellipse,
)
from orthonav.core.track.tracker import Tracker
from orthonav.onboard.cameras import FrozenCheck
from orthonav.onboard.gnss.monitor import DIFFERENTIAL
from orthonav.onboard.gnss.watch import GnssWatch
from orthonav.onboard.messages.estimate import (
    FilterCovariance,
    NavigationEstimate,
    estimate_from_result,
)
from orthonav.onboard.messages.gate import Gate
from orthonav.onboard.run import locate_view

WIND_MPS = 5.0
ROUTE_EN_M = np.array(
    [(-550, -550), (-550, 450), (-150, 550), (0, -450), (350, -550), (550, 250), (100, 550)], float
)
"""Corners over the demo area, flown round and round."""
REACH_M = 550.0
"""Of `ROUTE_EN_M`, from the middle."""
CARROT_M, CORNER_M = 70.0, 60.0
"""Distance of the point that is steered to; corners count as reached from so far away."""
LATENCY_S = 0.1
"""What a view gives reaches the filter so late."""
GRADES = {"px4": CONSUMER, "ardupilot": CALIBRATED}
START_STD_M, PRIOR_STD_M = 30.0, 100.0
"""Error of the position at a start without GNSS, and the deviation of every prior."""
SBAS_STD_M = 1.0
"""Stated by a receiver with corrections by SBAS."""
START_STD_MPS = {True: 3.0, False: 0.5}
"""The same of the velocity; a vehicle without an airspeed hovers."""
SETTLING_S = {True: 5.0, False: 15.0}
MESSAGE_STEPS = 10
"""Between messages to the filter: 5 a second, as of a camera, however rare the views are."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """What happens. GNSS is on for `gnss_s`, then off until `seconds`.

    `sends`: whether the filter gets positions of orthonav, else no views are taken; `velocity`:
    and the velocity of its track, as GPS_INPUT and ODOMETRY have it. `fault_s`,
    `lasts_s`: when the pictures are those of the fault that the `name` says.
    """

    name: str
    seconds: float
    gnss_s: float = 60.0
    sends: bool = True
    velocity: bool = False
    fault_s: float = math.inf
    lasts_s: float = 0.0

    def fault(self, time_s: float) -> str:
        """ "shifted", "mirrored" or "frozen"; empty without a fault."""
        return self.name if self.fault_s <= time_s < self.fault_s + self.lasts_s else ""


@dataclass(frozen=True)
class Course:
    """How an area is flown: height, half the sides of the rectangle that the route fills, and the
    time between views."""

    agl_m: float = 250.0
    reach_en_m: tuple[float, float] = (REACH_M, REACH_M)
    view_s: float = 0.2

    @property
    def corners_ne_m(self) -> Array:
        """Corners (N, 2) of the route, north and east."""
        return (ROUTE_EN_M * self.reach_en_m / REACH_M)[:, ::-1]


DEMO_COURSE = Course()


@dataclass(frozen=True, eq=False)
class Sample:
    """The autopilot at one exposure: true and estimated motion, and its claimed std, m."""

    time_s: float
    truth: Motion
    estimate: Motion
    claimed_m: float


@dataclass(frozen=True, eq=False)
class Located:
    """A view: what orthonav made of it.

    `error_m`: of the fix, NaN without one. `nees`: by its covariance. `level_m`: its protection
    level, infinite without a fix. `is_wrong`: beyond `FAR_M` and `FAR_STD` stated deviations.
    `sent_std_m`: as stated in the message, NaN where none was sent.
    """

    time_s: float
    state: str
    error_m: float
    nees: float
    level_m: float
    is_wrong: bool
    sent_std_m: float

    @property
    def sent(self) -> bool:
        return math.isfinite(self.sent_std_m)


@dataclass
class Flown:
    """What a flight left behind."""

    scenario: Scenario
    samples: list[Sample] = field(default_factory=list)
    views: list[Located] = field(default_factory=list)
    withheld: dict[str, int] = field(default_factory=dict)


class Route:
    """The point ahead on the route that is steered to."""

    def __init__(self, course: Course) -> None:
        self._corners_ne_m, self._leg = course.corners_ne_m, 0

    def carrot_ne(self, place_ne: Array) -> Array | None:
        """North and east (2,) of it, by the estimated position."""
        corners, count = self._corners_ne_m, len(self._corners_ne_m)
        begin, end = corners[self._leg], corners[(self._leg + 1) % count]
        length = float(np.hypot(*(end - begin)))
        along = float((place_ne - begin) @ (end - begin)) / length
        if along > length - CORNER_M:
            self._leg = (self._leg + 1) % count
            return self.carrot_ne(place_ne)
        return np.asarray(begin + (end - begin) / length * min(max(along, 0.0) + CARROT_M, length))


class Sight:
    """Camera and orthonav of one flight, as `orthonav fly --gnss watch` joins them.

    The map is displaced by what fixes state."""

    def __init__(self, area: Area, scenario: Scenario, autopilot: str, seed: int) -> None:
        self._area, self._scenario, self._seed = area, scenario, seed
        self._autopilot = autopilot
        self._tracker, self.gate = Tracker(area.localizer), Gate()
        self._solutions: deque[GnssSample] = deque()
        self._watch = GnssWatch(area.frame, self._solutions)
        self._frozen, self._covariance = FrozenCheck(), FilterCovariance()
        self._before: Grey | None = None
        self._displaced_m = np.random.default_rng([seed, 7]).normal(0.0, MAP_STD_M, 2)

    @property
    def frame(self) -> LocalFrame:
        return self._area.frame

    def receive(self, time_s: float, place_ne: Array, velocity: Array) -> None:
        """A solution of a receiver with corrections by SBAS."""
        lat, lon = self.frame.latlon_from_en(place_ne[::-1])
        time_ns, vel_en_mps = round(time_s * 1e9), (float(velocity[1]), float(velocity[0]))
        self._solutions.append(
            GnssSample(
                time_ns, time_ns, float(lat), float(lon), DIFFERENTIAL, SBAS_STD_M, vel_en_mps
            )
        )

    def look(
        self, time_s: float, truth: Motion, estimate: Motion, *, gnss: bool
    ) -> tuple[Located, NavigationEstimate | None]:
        """Locate one view, and the estimate of its message, None where the gate withholds it."""
        telemetry = self._telemetry(time_s, estimate, gnss)
        view = View(self._picture(time_s, truth), CAMERA, telemetry)
        if self._frozen.is_repeat(view.grey):
            outcome: Fix | NoFix = NoFix("frozen_image", "")
            made = None
        else:
            outcome, latency_ms = locate_view(self._tracker, view)
            state = self._tracker.state_name
            result = ViewResult("", telemetry.time_ns, outcome, latency_ms, state)
            self._watch.tick(telemetry.time_ns)
            result = self._watch.view(result, telemetry.time_ns)
            outcome = result.outcome
            made = estimate_from_result(result, processing_s=LATENCY_S)
        admitted, _ = self.gate.admit(made, telemetry.time_ns + round(LATENCY_S * 1e9))
        sent_std_m = math.nan
        if admitted is not None:
            prepared = self._covariance.prepare("", admitted, telemetry.time_ns)
            sent_std_m = prepared.horizontal_std_m()
        return self._judged(time_s, truth, outcome, sent_std_m), admitted

    def message(
        self, admitted: NavigationEstimate, seen: Motion, time_s: float, now: Motion
    ) -> tuple[tuple[Array, float], tuple[Array, float] | None]:
        """Position (2,) north and east of an estimate with the errors that it had when `seen`, at
        another moment, because the errors of overlapping views are alike, and as stated, m; and
        its velocity likewise, m/s, if it has one and the scenario sends it."""
        place = self.frame.en_from_latlon(admitted.lat_deg, admitted.lon_deg)
        exposed_ns = round(time_s * 1e9)
        std_m = self._covariance.prepare("", admitted, exposed_ns).horizontal_std_m()
        self._covariance.sent("", exposed_ns)
        placed = place[::-1] + (now.position - seen.position)[:2], std_m
        known = admitted.vel_en_mps is not None and admitted.vel_cov_en is not None
        if not (known and self._scenario.velocity):
            return placed, None
        velocity = np.array(admitted.vel_en_mps)[::-1] + (now.velocity - seen.velocity)[:2]
        largest = float(np.linalg.eigvalsh(np.array(admitted.vel_cov_en))[-1])
        return placed, (velocity, math.sqrt(largest))

    def _telemetry(self, time_s: float, estimate: Motion, gnss: bool) -> Telemetry:
        yaw, pitch, roll = np.degrees(euler_rad(estimate.rotation)).tolist()
        north, east, down = estimate.position.tolist()
        lat, lon = self.frame.latlon_from_en(np.array([east, north]))
        velocity = float(estimate.velocity[1]), float(estimate.velocity[0])
        prior = Prior(float(lat), float(lon), PRIOR_STD_M)
        telemetry = Telemetry(
            round(time_s * 1e9), yaw % 360, pitch, roll, -down, prior=prior, vel_en_mps=velocity
        )
        return stated(self._autopilot, replace(telemetry, home_m=-down), gnss)

    def _picture(self, time_s: float, truth: Motion) -> Grey:
        fault = self._scenario.fault(time_s)
        if fault == "frozen" and self._before is not None:
            return self._before
        yaw, pitch, roll = np.degrees(euler_rad(truth.rotation)).tolist()
        place = (
            truth.position[[1, 0]] + self._displaced_m + [300.0 if fault == "shifted" else 0.0, 0.0]
        )
        rng = np.random.default_rng([self._seed, round(time_s * 1e3)])
        height_m = float(-truth.position[2])
        grey = self._area.picture(place, (yaw, pitch, roll), height_m, rng)
        self._before = np.ascontiguousarray(grey[:, ::-1]) if fault == "mirrored" else grey
        return self._before

    def _judged(
        self, time_s: float, truth: Motion, outcome: Fix | NoFix, sent_std_m: float
    ) -> Located:
        error_m, nees, level_m, wrong = math.nan, math.nan, math.inf, False
        if isinstance(outcome, Fix):
            place = self.frame.en_from_latlon(outcome.lat_deg, outcome.lon_deg)
            off = place - truth.position[[1, 0]]
            nees = float(off @ np.linalg.solve(outcome.cov_en_m2, off))
            error_m = float(np.hypot(*off))
            level_m = outcome.protection_level_m()
            wrong = error_m > max(FAR_M, FAR_STD * error_ellipse(outcome.cov_en_m2)[0])
        state = self._tracker.state_name
        return Located(time_s, state, error_m, nees, level_m, wrong, sent_std_m)


def fly(
    scenario: Scenario,
    area: Area | None,
    *,
    vehicle: str,
    autopilot: str,
    seed: int,
    grade: Grade | None = None,
    course: Course = DEMO_COURSE,
) -> Flown:
    """Fly a scenario with a vehicle of `VEHICLES` and a filter of `FILTERS`.

    `area` is needed where orthonav sends.
    """
    rng = np.random.default_rng([seed, 3])
    wind = Wind(rng, np.array([*(WIND_MPS * _direction(rng)), 0.0]))
    place = np.array([*course.corners_ne_m[0], -course.agl_m])
    aircraft: Vehicle = VEHICLES[vehicle](rng, place, 0.0)
    aircraft.step(wind.next())
    instruments = Instruments(rng, grade or GRADES[autopilot])
    estimator = _started(rng, aircraft, instruments, autopilot, scenario.gnss_s > 0)
    sight = None
    if scenario.sends and area is not None:
        sight = Sight(area, scenario, autopilot, seed)
    flown, route = Flown(scenario), Route(course)
    view_steps = round(course.view_s / STEP_S)
    held: tuple[NavigationEstimate, Motion] | None = None  # what is sent, and the truth at its view
    for step in range(round(scenario.seconds / STEP_S)):
        time_s = step * STEP_S
        gnss = time_s < scenario.gnss_s
        if step % 2 == 0:
            estimate = estimator.output()
            carrot_ne = route.carrot_ne(estimate.position[:2])
            if estimator.is_alone and not aircraft.has_airspeed:
                carrot_ne = None  # the failsafe of a vehicle that does not know its velocity
            aircraft.steer(estimate, carrot_ne, course.agl_m)
        if step % view_steps == 0:
            truth = aircraft.motion
            claimed_m = math.sqrt(float(np.diag(estimator.covariance)[6:8].mean()))
            flown.samples.append(Sample(time_s, truth, estimate, claimed_m))
            if sight is not None:
                located, admitted = sight.look(time_s, truth, estimate, gnss=gnss)
                flown.views.append(located)
                held = None if admitted is None else (admitted, truth)
        if sight is not None and held is not None and step % MESSAGE_STEPS == 0:
            message = sight.message(*held, time_s, aircraft.motion)
            if not gnss:
                _give(estimator, *message)
        _sense(step, estimator, instruments, aircraft, wind, sight, gnss=gnss)
        before = aircraft.motion
        aircraft.step(wind.next())
        estimator.add_imu(instruments.imu(increments(before, aircraft.motion)))
    if sight is not None:
        flown.withheld = dict(sight.gate.withheld)
    return flown


def _direction(rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, math.tau)
    return np.array([math.cos(angle), math.sin(angle)])


def _started(
    rng: np.random.Generator,
    aircraft: Vehicle,
    instruments: Instruments,
    autopilot: str,
    gnss: bool,
) -> Filter:
    """A filter at the start: with GNSS, it knows position and velocity; without it, roughly."""
    truth = aircraft.motion
    place_m, mps = (1.0, 0.3) if gnss else (START_STD_M, START_STD_MPS[aircraft.has_airspeed])
    tuning = FILTERS[autopilot]
    stds = np.repeat([0.03, mps, 1.0, 0.01, 0.2, 5.0], [3, 3, 3, 3, 3, 2])
    stds[6:8] = place_m
    if not gnss:  # it was aligned while it stood
        stds[:2], stds[9:12] = 0.015, 0.001
    assert len(stds) == STATES
    off = stds * rng.normal(size=STATES)
    tilted = about(0, off[0]) @ about(1, off[1]) @ about(2, off[2])
    # The motions are shared; the filter's is its own.
    motion = Motion(
        truth.position + off[6:9] * [1, 1, 0.5],
        truth.velocity + off[3:6] * [1, 1, 0.1],
        tilted @ truth.rotation,
    )
    made = Filter(tuning, motion, stds)
    if not gnss:
        made.gyro_bias = instruments.gyro_bias + off[9:12]
    return made


def _give(
    estimator: Filter, placed: tuple[Array, float], moving: tuple[Array, float] | None
) -> None:
    """Give the filter a message, fused at its exposure, which the filter has yet to reach."""
    (place_ne, std_m), tuning = placed, estimator.tuning
    estimator.measure(partial(estimator.fuse_position, place_ne, max(std_m, tuning.least_m)))
    if moving is not None:
        velocity, std_mps = moving
        std_mps = max(std_mps, tuning.least_mps)
        estimator.measure(partial(estimator.fuse_velocity, velocity, std_mps))


def _sense(
    step: int,
    estimator: Filter,
    instruments: Instruments,
    aircraft: Vehicle,
    wind: Wind,
    sight: Sight | None,
    *,
    gnss: bool,
) -> None:
    """Measure what is due, at 10 Hz and GNSS at 5 Hz."""
    if step % 5:
        return
    motion = aircraft.motion
    height_m, heading = instruments.height_m(motion, 5 * STEP_S), instruments.heading_rad(motion)
    estimator.measure(lambda: estimator.fuse_height(height_m))
    estimator.measure(lambda: estimator.fuse_heading(heading))
    estimator.measure(estimator.fuse_gravity)
    if aircraft.has_airspeed:
        airspeed_mps = instruments.airspeed_mps(motion, wind)
        estimator.measure(lambda: estimator.fuse_air(airspeed_mps))
    if gnss and step % 10 == 0:
        place, velocity = instruments.gnss(motion)
        if sight is not None:
            sight.receive(step * STEP_S, place, velocity)
        tuning = estimator.tuning
        estimator.measure(lambda: estimator.fuse_position(place, tuning.gnss_m))
        estimator.measure(lambda: estimator.fuse_velocity(velocity, tuning.gnss_mps))


def spans(flown: Flown) -> tuple[Sequence[Sample], Sequence[Located]]:
    """Samples and views that are judged: without GNSS, `SETTLING_S` after it was cut or, where it
    never was on, after the start."""
    gnss_s = flown.scenario.gnss_s
    begin_s = 30.0 if gnss_s >= flown.scenario.seconds else gnss_s + SETTLING_S[gnss_s > 0]
    samples = [each for each in flown.samples if each.time_s >= begin_s]
    return samples, [each for each in flown.views if each.time_s >= begin_s]


GNSS_S, BEFORE_S, AFTER_S = 60.0, 60.0, 60.0
"""With GNSS, then without it before a disturbance, and after it."""
SCENARIOS = ("gnss", "nothing", "fixes", "start", "shifted", "mirrored", "frozen")
LASTS_S = {"shifted": 40.0, "mirrored": 40.0, "frozen": 10.0}
HEADER = (
    *("scenario", "position median m", "95 %", "max", "position NEES"),
    *("fixes median m", "95 %", "NEES", "sent", "false"),
)


def scenario(name: str, minutes: float) -> Scenario:
    """A scenario of `SCENARIOS`; `minutes` without GNSS, unless it has a disturbance or `gnss`."""
    if name == "gnss":
        return Scenario(name, GNSS_S + 60 * minutes, gnss_s=GNSS_S + 60 * minutes, sends=False)
    if name == "start":
        return Scenario(name, min(60 * minutes, 240.0), gnss_s=0.0)
    if name not in LASTS_S:
        return Scenario(name, GNSS_S + 60 * minutes, GNSS_S, sends=name == "fixes")
    begin_s, lasts_s = GNSS_S + BEFORE_S, LASTS_S[name]
    seconds = begin_s + lasts_s + AFTER_S
    return Scenario(name, seconds, GNSS_S, fault_s=begin_s, lasts_s=lasts_s)


def cells(flown: Flown) -> list[str]:
    samples, views = spans(flown)
    off = np.array([each.estimate.position - each.truth.position for each in samples])
    far_m = np.hypot(*off[:, :2].T)
    claimed = np.array([each.claimed_m for each in samples])
    sent = [view for view in views if view.sent]
    errors = np.array([view.error_m for view in sent])
    return [
        flown.scenario.name,
        *quantiles(far_m, 50, 95),
        number(float(far_m.max())),
        number(float(np.mean((far_m / claimed) ** 2))),
        *quantiles(errors, 50, 95),
        number(float(np.mean([view.nees for view in sent]))) if sent else "-",
        f"{len(sent) / len(views):.0%}" if views else "-",
        str(sum(view.is_wrong for view in sent)) if views else "-",
    ]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--vehicle", choices=VEHICLES, default="plane")
    parser.add_argument("--filter", choices=FILTERS, default="px4", help="instruments and tuning")
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    parser.add_argument("--velocity", action="store_true", help="the filter gets it too")
    parser.add_argument("--minutes", type=float, default=10.0, help="without GNSS (default 10)")
    parser.add_argument("--seed", type=int, nargs="+", default=[1], help="one flight each")


def measure(options: argparse.Namespace) -> Section:
    """Scenarios of a vehicle with a filter, each with each seed."""
    area, rows = Area.demo(options.work), []
    minutes = 0.5 if options.quick else options.minutes
    for seed, name in product(options.seed, options.only):
        aircraft = {"vehicle": options.vehicle, "autopilot": options.filter}
        flight = replace(scenario(name, minutes), velocity=options.velocity)
        flown = fly(flight, area, seed=seed, **aircraft)
        rows.append(cells(flown))
        if len(options.seed) > 1:
            rows[-1][0] += f", seed {seed}"
        say(f"{' | '.join(rows[-1])} {flown.withheld}")
    notes = (
        f"{minutes:g} minutes without GNSS, {GNSS_S:g} s with it; the map is displaced by "
        f"{MAP_STD_M:g} m per axis; position: errors of the autopilot; false: sent, and "
        f"more than {FAR_M:g} m and {FAR_STD:g} stated deviations off",
    )
    title = (
        f"{options.vehicle}, filter like {options.filter}'s" + ", velocity too" * options.velocity
    )
    return Section("Flights in the loop", [Table(title, HEADER, rows, notes)])
