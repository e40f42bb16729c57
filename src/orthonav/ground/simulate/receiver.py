"""Simulated GNSS receivers: errors of a good one, and those that are spoofed, drift, freeze or lose
their fix."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import UsageError
from orthonav.core.flight.gnss import GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.variants import Table, Variant, make_variant
from orthonav.ground.simulate.motion import direction, gauss_markov

RATE_HZ = 5.0  # rate of solutions: the default of autopilots
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReceiverErrors:
    """Errors of a receiver without a fault; its slowly varying one is `Good.std_m`."""

    slow_s: float = 180.0  # time constant of the slow error: ionosphere, orbits
    noise_std_m: float = 0.3  # per axis from solution to solution
    multipath_per_hour: float = 20.0
    max_multipath_m: float = 6.0
    multipath_s: tuple[float, float] = (5.0, 60.0)  # least and longest duration
    velocity_noise_mps: float = 0.05  # of the Doppler velocity, per axis
    velocity_drift_mps: float = 0.08  # its slowly varying error
    velocity_drift_s: float = 60.0  # time constant of that
    latency_s: float = 0.12  # age of a solution at its timestamp, unknown to the receiver
    stated_std_m: float = 1.5  # less than its error, as receivers do
    satellites: int = 16


ERRORS = ReceiverErrors()


@dataclass(frozen=True, eq=False)
class GnssTrack:
    times_s: Array  # (N,) time of the message
    solved_s: Array  # (N,) timestamp by the receiver
    en_m: Array  # (N, 2) positions
    vel_en_mps: Array  # (N, 2) velocities
    fix_type: NDArray[np.int64]  # (N,) 3 for a 3D fix, as GPS_FIX_TYPE of MAVLink
    std_m: Array  # (N,) stated standard deviation
    satellites: NDArray[np.int64]  # (N,)


@dataclass(frozen=True)
class Good:
    """A receiver without a fault; `std_m` is that of its slowly varying error per axis."""

    std_m: float = 2.0

    def __post_init__(self) -> None:
        limits = {"std_m": 100.0, "at_s": 1e9, "metres": 1e6, "mps": 1e3}
        limits |= dict.fromkeys(("over_s", "every_s", "for_s"), 1e9)
        for name, most in limits.items():
            value = getattr(self, name, 0.0)
            if not 0 <= value <= most:
                raise UsageError(f"GNSS receiver: {name} must be 0 to {most:g}, got {value:g}")

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        return track


@dataclass(frozen=True)
class Step(Good):
    """Spoofed by a step of `metres` to `bearing_deg` at `at_s`. It takes `over_s`, and the velocity
    follows it; with 0 it is sudden, and the velocity does not."""

    at_s: float = 60.0
    metres: float = 30.0
    bearing_deg: float = 90.0
    over_s: float = 0.0

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        towards, seconds = direction(self.bearing_deg), track.times_s - self.at_s
        if self.over_s == 0:
            return replace(track, en_m=track.en_m + (seconds >= 0)[:, None] * self.metres * towards)
        share = np.clip(seconds / self.over_s, 0, 1)[:, None]
        moving = ((seconds > 0) & (seconds < self.over_s))[:, None]
        return replace(
            track,
            en_m=track.en_m + share * self.metres * towards,
            vel_en_mps=track.vel_en_mps + moving * self.metres / self.over_s * towards,
        )


@dataclass(frozen=True)
class Drag(Good):
    """Spoofed: dragged off from `at_s` on at `mps` towards `bearing_deg`, its velocity too."""

    at_s: float = 60.0
    mps: float = 1.0
    bearing_deg: float = 90.0

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        seconds = np.maximum(track.times_s - self.at_s, 0.0)[:, None]
        towards = self.mps * direction(self.bearing_deg)
        velocity = track.vel_en_mps + (seconds > 0) * towards
        return replace(track, en_m=track.en_m + seconds * towards, vel_en_mps=velocity)


@dataclass(frozen=True)
class Drift(Drag):
    mps: float = 0.5

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        return replace(super()._with_fault(track), vel_en_mps=track.vel_en_mps)


@dataclass(frozen=True)
class Frozen(Good):
    """A receiver that repeats the solution of `at_s`; with `stale` 1 its timestamp too."""

    at_s: float = 60.0
    stale: int = 0

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        last = max(int(np.searchsorted(track.times_s, self.at_s)) - 1, 0)
        source = np.minimum(np.arange(len(track.times_s)), last)
        solved = track.solved_s[source] if self.stale else track.solved_s
        velocity = track.vel_en_mps[source]
        return replace(track, en_m=track.en_m[source], vel_en_mps=velocity, solved_s=solved)


@dataclass(frozen=True)
class Jumping(Good):
    """A receiver that jumps by `metres` and back every `every_s` from `at_s` on."""

    at_s: float = 60.0
    metres: float = 40.0
    every_s: float = 5.0

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        phase = np.floor((track.times_s - self.at_s) / max(self.every_s, 0.1))
        away = (phase >= 0) & (phase % 2 == 0)
        return replace(track, en_m=track.en_m + away[:, None] * self.metres * direction(45.0))


@dataclass(frozen=True)
class Jam(Good):
    """A receiver without a fix from `at_s` on, for `for_s`; with `silent` 1 without messages."""

    at_s: float = 60.0
    for_s: float = 1e9
    silent: int = 0

    def _with_fault(self, track: GnssTrack) -> GnssTrack:
        gone = (track.times_s >= self.at_s) & (track.times_s < self.at_s + self.for_s)
        if self.silent:
            return GnssTrack(**{name: value[~gone] for name, value in vars(track).items()})
        fix_type = np.where(gone, 1, track.fix_type)
        satellites = np.where(gone, 2, track.satellites)
        return replace(
            track, fix_type=fix_type, satellites=satellites, std_m=np.where(gone, 99.0, track.std_m)
        )


RECEIVERS: Table = MappingProxyType(  # those that `orthonav simulate --receiver` knows
    {
        cls.__name__.lower(): Variant(f"orthonav.ground.simulate.receiver:{cls.__name__}")
        for cls in (Good, Step, Drag, Drift, Frozen, Jumping, Jam)
    }
)


def receiver_of(text: str) -> Good:
    made: Good = make_variant(RECEIVERS, text)
    return made


def solutions(
    receiver: Good,
    times_s: Array,
    places_en_m: Array,
    rng: np.random.Generator,
    rate_hz: float = RATE_HZ,
) -> GnssTrack:
    """Solutions along true positions (M, 2) at times (M,), `rate_hz` of them a second."""
    end_s = float(times_s[-1])
    count = int((end_s - times_s[0]) * rate_hz) + 1
    times = times_s[0] + np.arange(count) / rate_hz
    before, place, after = (
        _interpolated(times - ERRORS.latency_s + off_s, times_s, places_en_m)
        for off_s in (-0.5, 0.0, 0.5)
    )
    step_s = 1 / rate_hz
    slow = receiver.std_m * gauss_markov(step_s / ERRORS.slow_s, count, rng)
    place = place + slow + _multipath(times, rng) + rng.normal(0, ERRORS.noise_std_m, (count, 2))
    velocity = after - before + rng.normal(0, ERRORS.velocity_noise_mps, (count, 2))
    drift = gauss_markov(step_s / ERRORS.velocity_drift_s, count, rng)
    velocity += ERRORS.velocity_drift_mps * drift
    good = GnssTrack(
        times,
        times.copy(),
        place,
        velocity,
        np.full(count, 3),
        np.full(count, ERRORS.stated_std_m),
        np.full(count, ERRORS.satellites),
    )
    return receiver._with_fault(good)


def samples_of(track: GnssTrack, frame: LocalFrame) -> Iterator[GnssSample]:
    lat, lon = frame.latlon_from_en(track.en_m)
    for i, arrived_s in enumerate(track.times_s):
        solved_ns = round(track.solved_s[i] * 1e9)
        yield GnssSample(
            time_ns=solved_ns,
            arrived_ns=round(arrived_s * 1e9),
            lat_deg=float(lat[i]),
            lon_deg=float(lon[i]),
            fix_type=int(track.fix_type[i]),
            std_m=float(track.std_m[i]),
            vel_en_mps=(float(track.vel_en_mps[i, 0]), float(track.vel_en_mps[i, 1])),
            satellites=int(track.satellites[i]),
            stamp_ns=solved_ns,
        )


def _multipath(times: Array, rng: np.random.Generator) -> Array:
    off = np.zeros((len(times), 2))
    hours = (times[-1] - times[0]) / 3600
    for _ in range(rng.poisson(ERRORS.multipath_per_hour * hours)):
        begin = rng.uniform(times[0], times[-1])
        during = (times >= begin) & (times < begin + rng.uniform(*ERRORS.multipath_s))
        off[during] += rng.uniform(0, ERRORS.max_multipath_m) * direction(rng.uniform(0, 360))
    return off


def _interpolated(at_s: Array, times_s: Array, places: Array) -> Array:
    """Positions (N, 2), also before the first and after the last, by the velocity there."""
    made = np.stack([np.interp(at_s, times_s, column) for column in places.T], axis=1)
    if len(times_s) > 1:
        first = (places[1] - places[0]) / (times_s[1] - times_s[0])
        last = (places[-1] - places[-2]) / (times_s[-1] - times_s[-2])
        made += np.minimum(at_s - times_s[0], 0.0)[:, None] * first
        made += np.maximum(at_s - times_s[-1], 0.0)[:, None] * last
    return made
