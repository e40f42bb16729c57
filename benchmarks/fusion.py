"""Whether a filter that takes our positions as independent claims the right accuracy.

`python -m benchmarks.fusion [--flights 8] [--rates 5 2 1] [--averaging-s S ..] [--work DIR]` flies
over a generated area with errors of attitude, heading and height, follows every flight with
`Tracker` from no prior, and gives the positions that would be sent to Kalman filters of constant
velocity, once with the covariance of the fix and once with the one that is sent
(`orthonav.onboard.messages.estimate`). It prints the mean normalized error squared (NEES) of the
filters' positions over its expected value: 1 is right, more is too confident. Recorded flights of
the optional real imagery follow where they are at hand. Area, map and flights stay in the work
folder.
"""

import argparse
import math
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import long_flights
from benchmarks.inputs import PAST, PRESENT, REAL_DATA, Workplace
from benchmarks.record import Section, Table, number
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, MAP_STD_M, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.ground.simulate.motion import Wind
from orthonav.onboard.messages import estimate as estimates
from orthonav.onboard.messages.estimate import FilterCovariance, estimate_from_result
from orthonav.onboard.run import localize_flight

AREA_M, GSD_M, REACH_M = 3000, 1.0, 1100.0
AGL_M, SPEED_MPS, TURN_RADIUS_M, WIND_MPS = 250.0, 20.0, 150.0, 5.0
CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
LENGTH_M, LENGTH_S = 6000.0, {5.0: 150.0, 2.0: 200.0, 1.0: 300.0}
YAW_BIAS_DEG, AGL_BIAS, TILT_BIAS_DEG = 3.0, 0.05, 1.0
SCATTER = Errors(
    yaw_std_deg=1.0, agl_std=0.01, tilt_std_deg=0.3, attitude_std_deg=2.0, velocity_drift=0.02
)
SEED, FLIGHT_SEED, CALIBRATION = 77, 1000, 3
"""The first flights of each rate chose `orthonav.onboard.messages.estimate.AVERAGING_S`."""
SETTLING_S = 30.0
"""A filter is judged from so long after its first position on."""
RECORDED = (
    ("Arroio, 2014-01", "arroio_maps/2014-01.tif", "arroio_drone_1"),
    ("Arroio, 2014-03", "arroio_maps/2014-03.tif", "arroio_drone_1"),
    ("Taichung", "taichung_drone/map.tif", "taichung_drone"),
)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Receiver:
    """A Kalman filter of constant velocity.

    `velocity_walk`: density of the white noise of the acceleration, m2/s3. `acceleration_walk`: of
    its derivative, m2/s5. `inertial`: the acceleration is measured, with these errors; else it is
    not known at all.
    """

    name: str
    velocity_walk: float
    acceleration_walk: float = 0.0
    inertial: bool = True


STEP_S, GRAVITY_MPS2 = 0.01, 9.81
RECEIVERS = (
    # Defaults of EKF2_ACC_NOISE and EKF2_GYR_NOISE, drawn at every step; a tilt accelerates.
    Receiver("PX4's noise", 0.35**2 * STEP_S, (GRAVITY_MPS2 * 0.015) ** 2 * STEP_S),
    # A tilt error of 1 deg, 0.17 m/s2, that lasts 3 s.
    Receiver("acceleration measured", 0.2),
    # Manoeuvres of 0.8 m/s2 that last 1.5 s: its lag in the turns of these flights fits its claim.
    Receiver("no inertial sensor", 2.0, inertial=False),
)


@dataclass(frozen=True, eq=False)
class Fixes:
    """Confident positions of a tracked flight, in order.

    `times_s` (N,). `places_en_m`, `truth_en_m` (N, 2). `own_m2`, `sent_m2` (N,): variance along the
    worst direction of the fix, and as stated in messages. `map_std_m`: standard deviation of a map
    displacement that the errors do not contain and the covariance does.
    """

    times_s: Array
    places_en_m: Array
    truth_en_m: Array
    own_m2: Array
    sent_m2: Array
    map_std_m: float

    @property
    def own_ratio(self) -> float:
        """Mean NEES of the fixes over the expected one."""
        squared = ((self.places_en_m - self.truth_en_m) ** 2).sum(1) / 2 + self.map_std_m**2
        return float((squared / self.own_m2).mean())


@dataclass(frozen=True)
class Fused:
    """What a receiver made of a flight: NEES over the expected one, and the claimed and the actual
    error per axis, m."""

    ratio: float
    claimed_m: float
    actual_m: float


def fixes_of(
    results: Iterable[ViewResult],
    truth: dict[str, tuple[float, float]],
    frame: LocalFrame,
    map_std_m: float,
) -> Fixes:
    """The positions of a flight that would be sent, with their covariances."""
    covariance = FilterCovariance()
    rows = []
    for result in results:
        estimate = estimate_from_result(result)
        if estimate is None or not estimate.is_confident(CONFIDENT):
            continue
        stated = covariance.prepare("", estimate, result.time_ns)
        covariance.sent("", result.time_ns)
        place = frame.en_from_latlon(estimate.lat_deg, estimate.lon_deg)
        true = frame.en_from_latlon(*truth[result.frame])
        own_m2, sent_m2 = estimate.horizontal_std_m() ** 2, stated.horizontal_std_m() ** 2
        rows.append([result.time_ns / 1e9, *place, *true, own_m2, sent_m2])
    table = np.array(rows)
    return Fixes(table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5], table[:, 6], map_std_m)


def fuse(receiver: Receiver, fixes: Fixes, variances_m2: Array) -> Fused:
    """Fuse positions with these variances (N,), one for both axes, as independent.

    An inertial receiver estimates the difference from the true motion, which its sensors follow
    with errors of its process noise. Two errors enter by their expected squares: `response` is the
    share of a constant displacement of the map that has reached the state, `drift` the covariance
    of what the sensors' errors made of it.
    """
    origin = fixes.truth_en_m if receiver.inertial else np.zeros(2)
    measured, true = fixes.places_en_m - origin, fixes.truth_en_m - origin
    mean, response, drift = np.zeros((3, 2)), np.zeros(3), np.zeros((3, 3))
    mean[0], response[0] = measured[0], 1.0
    if not receiver.inertial:
        mean[1] = (true[1] - true[0]) / (fixes.times_s[1] - fixes.times_s[0])
    cov = np.diag([variances_m2[0], 4.0, 0.04 if receiver.acceleration_walk else 0.0])
    squared, claimed_m2 = [], []
    for k in range(1, len(measured)):
        step, noise = _motion(receiver, fixes.times_s[k] - fixes.times_s[k - 1])
        mean, response, cov = step @ mean, step @ response, step @ cov @ step.T + noise
        gain = cov[:, 0] / (cov[0, 0] + variances_m2[k])
        mean += np.outer(gain, measured[k] - mean[0])
        response += gain * (1.0 - response[0])
        left = np.eye(3) - np.outer(gain, [1.0, 0.0, 0.0])
        cov = left @ cov
        if receiver.inertial:
            drift = left @ (step @ drift @ step.T + noise) @ left.T
        if fixes.times_s[k] - fixes.times_s[0] > SETTLING_S:
            error_m2 = float(((mean[0] - true[k]) ** 2).sum()) / 2
            squared.append(error_m2 + (fixes.map_std_m * response[0]) ** 2 + drift[0, 0])
            claimed_m2.append(cov[0, 0])
    ratio = float(np.mean(np.array(squared) / claimed_m2))
    return Fused(ratio, math.sqrt(np.mean(claimed_m2)), math.sqrt(np.mean(squared)))


def _motion(receiver: Receiver, seconds: float) -> tuple[Array, Array]:
    """Transition (3, 3) of position, velocity, acceleration, and process noise (3, 3)."""
    t = seconds
    step = np.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    noise = np.zeros((3, 3))
    noise[:2, :2] = receiver.velocity_walk * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    noise += receiver.acceleration_walk * np.array(
        [
            [t**5 / 20, t**4 / 8, t**3 / 6],
            [t**4 / 8, t**3 / 3, t**2 / 2],
            [t**3 / 6, t**2 / 2, t],
        ]
    )
    return step, noise


def flown(work: Path, seed: int, rate_hz: float, frame: LocalFrame, ortho: Path) -> Path:
    """Folder of a generated flight, simulated if absent."""
    folder = work / f"fused-{seed}-{rate_hz:g}"
    if folder.is_dir():
        return folder
    rng = np.random.default_rng([SEED, seed])
    line = _cut(_legs(rng), LENGTH_S[rate_hz] * SPEED_MPS)
    yaw, agl, pitch, roll = rng.normal(size=4)
    errors = replace(
        SCATTER,
        yaw_bias_deg=float(yaw) * YAW_BIAS_DEG,
        agl_bias=float(agl) * AGL_BIAS,
        pitch_bias_deg=float(pitch) * TILT_BIAS_DEG,
        roll_bias_deg=float(roll) * TILT_BIAS_DEG,
    )
    lat, lon = frame.latlon_from_en(line)
    request = SimulateRequest(
        [ortho],
        folder,
        route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
        agl_m=AGL_M,
        spacing_m=SPEED_MPS / rate_hz,
        airspeed_mps=SPEED_MPS,
        camera=CAMERA,
        errors=errors,
        seed=FLIGHT_SEED + seed,
        wind=Wind(WIND_MPS, float(rng.uniform(0, 360))),
        turn_radius_m=TURN_RADIUS_M,
    )
    simulate_flight(request)
    return folder


def _legs(rng: np.random.Generator) -> Array:
    """Corners (N, 2) of a route of random legs."""
    return long_flights.random_legs(rng, LENGTH_M, REACH_M, (500.0, 1500.0))


def _cut(line: Array, length_m: float) -> Array:
    """The beginning of a line (N, 2), `length_m` long."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    inside = line[along < length_m]
    end = [np.interp(length_m, along, line[:, axis]) for axis in (0, 1)]
    return np.vstack([inside, end])


def _followed(localizer: Localizer, folder: Path, map_std_m: float) -> Fixes:
    results = localize_flight(Tracker(localizer, use_prior=False), open_flight(folder))
    truth = read_truth(folder / "truth.csv")
    return fixes_of(results, truth, localizer.sheet.frame, map_std_m)


HEADER = (
    *("flights", "rate Hz", "fixes", "error m", "stated m", "NEES of the fixes", "receiver"),
    *("with the fix's covariance", "with the sent one", "claimed m", "actual m"),
)


def _rows(name: str, rate: str, flights: Sequence[Fixes]) -> list[list[str]]:
    """A row for each receiver, means over flights."""
    errors = np.concatenate([each.places_en_m - each.truth_en_m for each in flights])
    rmse_m = math.sqrt(float((errors**2).sum(1).mean()))
    stated_m = math.sqrt(float(np.mean(np.concatenate([each.own_m2 for each in flights]))))
    own = float(np.mean([each.own_ratio for each in flights]))
    begin = [name, rate, str(len(errors)), number(rmse_m), number(stated_m), f"{own:.2f}"]
    rows = []
    for receiver in RECEIVERS:
        plain = [fuse(receiver, each, each.own_m2).ratio for each in flights]
        made = [fuse(receiver, each, each.sent_m2) for each in flights]
        ratios = [each.ratio for each in made]
        spread = f" ({min(ratios):.2f} to {max(ratios):.2f})" if len(ratios) > 1 else ""
        rows.append(
            [
                *begin,
                receiver.name,
                f"{np.mean(plain):.2f}",
                f"{np.mean(ratios):.2f}{spread}",
                number(float(np.mean([each.claimed_m for each in made]))),
                number(float(np.mean([each.actual_m for each in made]))),
            ]
        )
    return rows


def _generated(options: argparse.Namespace, work: Path) -> list[list[str]]:
    place = Workplace(work, work / "data", quick=False)
    past, present = place.area(AREA_M, GSD_M, [PAST, PRESENT])
    localizer = Localizer(open_map(place.map(past)))
    frame, rows = localizer.sheet.frame, []
    for rate in options.rates:
        flights = []
        for seed in range(options.flights):
            folder = flown(work, seed, rate, frame, present)
            flights.append(_followed(localizer, folder, MAP_STD_M))
            print(f"        {rate:g} Hz, flight {seed}", file=sys.stderr, flush=True)
        for name, group in (
            ("calibration", flights[:CALIBRATION]),
            ("others", flights[CALIBRATION:]),
        ):
            rows += _rows(name, f"{rate:g}", group) if group else []
    return rows


def _recorded(work: Path) -> list[list[str]]:
    rows = []
    for name, ortho, views in RECORDED:
        if not (REAL_DATA / ortho).is_file():
            print(f"{name} skipped: the optional real imagery is absent", file=sys.stderr)
            continue
        path = work / f"{ortho.replace('/', '-')}.onav"
        if not path.is_file():
            build_map(BuildRequest([REAL_DATA / ortho], path))
        fixes = _followed(Localizer(open_map(path)), REAL_DATA / views, 0.0)
        rate = 1 / float(np.median(np.diff(fixes.times_s)))
        rows += _rows(name, f"{rate:.2g}", [fixes])
    return rows


def main(arguments: Sequence[str]) -> int:
    """Fly, follow, fuse and print the tables; returns the exit code."""
    options = _parser().parse_args(arguments)
    cv2.setNumThreads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    notes = (
        f"flights {AGL_M:g} m above ground at {SPEED_MPS:g} m/s over another date than the map's; "
        f"mount off by {TILT_BIAS_DEG:g} deg, heading by {YAW_BIAS_DEG:g} deg, height by "
        f"{AGL_BIAS:.0%} (standard deviations, drawn once per flight); a map displacement of "
        f"{MAP_STD_M:g} m per axis enters by its expected square",
        "NEES over the expected one: 1 is right, more is too confident; of a filter from "
        f"{SETTLING_S:g} s after its first position on; smallest and largest flight in brackets",
        "recorded flights: the error of the reference is part of the error",
    )
    for averaging_s in options.averaging_s or [estimates.AVERAGING_S]:
        estimates.AVERAGING_S = averaging_s
        rows = _generated(options, options.work) + _recorded(options.work)
        title = f"Filters that take positions as independent, averaging {averaging_s:g} s"
        section = Section(title)
        section.tables = [Table(title, HEADER, rows, notes)]
        print(section.markdown())
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fusion", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--flights", type=int, default=8, help="per rate (default 8)")
    parser.add_argument(
        "--rates", type=float, nargs="+", choices=sorted(LENGTH_S), default=[5.0, 2.0, 1.0]
    )
    parser.add_argument(
        "--averaging-s", type=float, nargs="+", help="try other averaging times of receivers, s"
    )
    parser.add_argument("--work", type=Path, default=Path("bench_results/fusion"))
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
