"""The difference GNSS minus map: its constant biases, the tests of a change, and learning.

It is linear in the biases: a displacement of the map is constant, an error of the mount turns with
the heading and grows with the height, a latency acts along the velocity over ground.

The tests are generalized likelihood ratios (Willsky and Jones 1976, doi:10.1109/TAC.1976.1101146)
over a window instead of a recursion. Learning is a Kalman filter whose state has the slowly varying
errors too: with these the covariance of the biases is honest. A spoofed receiver must not move the
map: values wait in quarantine, an offset discards all since the reference, outliers are left out,
and the biases are bounded (docs/gnss.md).
"""

import copy
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.flight.gnss import Fault
from orthonav.core.records import MAP_STD_M

Array = NDArray[np.float64]
NAMES = ("east_m", "north_m", "pitch_rad", "roll_rad", "latency_s")
"""Biases in the order of `Biases.mean`."""
LARGEST_M = 100.0
"""Largest displacement; a larger difference is a fault."""
LIMITS = np.array([LARGEST_M, LARGEST_M, math.radians(10), math.radians(10), 1.0])
"""Largest magnitude of each bias."""
_PRIOR_STD = np.array([30.0, 30.0, math.radians(1.5), math.radians(1.5), 0.2])
"""Assumed of a map and a camera of which nothing was learnt: a displacement of 60 m, a mount that
was aligned by eye to 3 deg and a latency of 0.4 s are 2 sigma."""
_BETWEEN_STD = np.array([0.0, 0.0, math.radians(0.3), math.radians(0.3), 0.03])
"""Change from flight to flight: a camera that was taken off, a latency that was measured again."""


@dataclass(frozen=True, eq=False)
class Biases:
    """Estimated biases of GNSS minus map.

    `mean` (5,), `cov` (5, 5): in the order of `NAMES`. East and north are where the map should be,
    from where it is. Pitch and roll are errors of the reported tilt, as `Mount` has them. The
    latency is that of the images less that of GNSS."""

    mean: Array
    cov: Array
    agreed_s: float = 0.0  # time of agreement that they were learnt from
    setup: str = ""  # identifies camera, mount and stated latency, for which the last three hold

    @property
    def en_m(self) -> Array:
        """Displacement of the map, east and north (2,)."""
        return self.mean[:2]

    @property
    def stds(self) -> Array:
        return np.sqrt(np.diag(self.cov))

    @property
    def std_m(self) -> float:
        """Standard deviation of the displacement along its worst axis."""
        return math.sqrt(float(np.linalg.eigvalsh(self.cov[:2, :2])[-1]))

    @property
    def is_plausible(self) -> bool:
        """Whether the displacement is within five of the standard deviations that fixes include for
        it. Else the map is wrong, or the receiver spoofed."""
        largest_m = 5.0 * MAP_STD_M + 2 * self.std_m
        return float(np.hypot(*self.en_m)) <= largest_m

    @property
    def displacement(self) -> tuple[Array, Array]:
        """That of a map as accurate as fixes state: mean (2,) and covariance (2, 2), metres.

        The mean is at most twice their standard deviation, then with the covariance of fixes: no
        spoofed receiver moves a position by more."""
        known, limit_m = np.linalg.inv(self.cov), 2 * MAP_STD_M
        # What a track leaves: its covariance includes the displacement, it estimates the mount.
        track_std = np.array([MAP_STD_M, MAP_STD_M, *_BETWEEN_STD[2:]])
        # They were learnt from a wider prior, which that of a track replaces.
        cov = np.linalg.inv(known + np.diag(track_std**-2 - _PRIOR_STD**-2))
        mean = (cov @ known @ self.mean)[:2]
        length_m = float(np.hypot(*mean))
        if length_m > limit_m:
            return mean * (limit_m / length_m), np.eye(2) * MAP_STD_M**2
        return mean, np.asarray(cov[:2, :2])

    def variance_m2(self, design: Array) -> float:
        """Variance of GNSS minus map along the worst axis, for the `design` (2, 5) of a view."""
        return float(np.linalg.eigvalsh(design @ self.cov @ design.T)[-1])

    def without_displacement(self) -> "Biases":
        mean, cov = self.mean.copy(), self.cov.copy()
        mean[:2] = cov[:2] = cov[:, :2] = 0.0
        return replace(self, mean=mean, cov=cov)

    def to_plain(self) -> dict[str, Any]:
        """Values for strict JSON; the covariance as its lower triangle, row by row."""
        return {
            "mean": self.mean.tolist(),
            "cov": self.cov[np.tril_indices(len(NAMES))].tolist(),
            "agreed_s": self.agreed_s,
            "setup": self.setup,
        }


def biases_from_plain(plain: Mapping[str, Any]) -> Biases:
    """Inverse of `Biases.to_plain`.

    Raises `ValueError`, `KeyError`, `TypeError` or `OverflowError` for values that are no estimate,
    or beyond `LIMITS`.
    """
    count = len(NAMES)
    mean, lower = (np.array([float(each) for each in plain[name]]) for name in ("mean", "cov"))
    agreed_s, setup = float(plain["agreed_s"]), plain["setup"]
    if (len(mean), len(lower)) != (count, count * (count + 1) // 2):
        raise ValueError("wrong number of values")
    if not (np.isfinite(lower).all() and (np.abs(mean) <= LIMITS).all()):
        raise ValueError("value out of range")
    if not (0 <= agreed_s <= 1e9 and isinstance(setup, str)):
        raise ValueError("time of agreement or setup is invalid")
    cov = np.zeros((count, count))
    cov[np.tril_indices(count)] = lower
    cov += np.tril(cov, -1).T
    scaled = cov / np.multiply.outer(_PRIOR_STD, _PRIOR_STD)
    if np.linalg.eigvalsh(scaled)[0] < 1e-12 or np.diag(scaled).max() > 4.0:
        raise ValueError("not a covariance")
    return Biases(mean, cov, agreed_s, setup)


def unknown(setup: str = "") -> Biases:
    """The biases assumed where nothing was learnt."""
    return Biases(np.zeros(len(NAMES)), np.diag(_PRIOR_STD**2), 0.0, setup)


def at_start(known: Mapping[str, Biases], digest: str, setup: str) -> Biases:
    """The biases known before a flight over the map `digest` with the camera of `setup`.

    `known`: what was learnt of maps, by their digest, the latest last. The displacement belongs to
    the map, the other biases to the setup: they are those of this map, or of the latest with the
    same setup.
    """
    start, here = unknown(setup), known.get(digest)
    same = [each for each in known.values() if each.setup == setup]
    if here is not None and here.setup == setup:
        start = here
    else:
        place, camera = here or start, same[-1] if same else start
        cov = np.zeros_like(start.cov)
        cov[:2, :2], cov[2:, 2:] = place.cov[:2, :2], camera.cov[2:, 2:]
        mean = np.concatenate([place.mean[:2], camera.mean[2:]])
        start = Biases(mean, cov, place.agreed_s, setup)
    cov = start.cov + np.diag(_BETWEEN_STD**2)
    # no less certain than where nothing was learnt, however many flights did not show a bias
    scale = np.minimum(_PRIOR_STD / np.sqrt(np.diag(cov)), 1.0)
    return replace(start, cov=np.multiply.outer(scale, scale) * cov)


def design(heading_rad: ArrayLike, agl_m: ArrayLike, vel_en_mps: Array) -> Array:
    """Derivatives (..., 2, 5) of GNSS minus map, east and north, by the biases.

    `heading_rad`, `agl_m` (...): of the view, clockwise from north, and above ground.
    `vel_en_mps` (..., 2): velocity over ground.
    """
    sin, cos, height = np.sin(heading_rad), np.cos(heading_rad), np.asarray(agl_m)
    made = np.zeros((*np.shape(sin), 2, len(NAMES)))
    made[..., 0, 0] = made[..., 1, 1] = 1.0
    made[..., 0, 2], made[..., 1, 2] = -height * sin, -height * cos  # the map's place is ahead
    made[..., 0, 3], made[..., 1, 3] = height * cos, -height * sin  # the map's place is left
    made[..., 4] = vel_en_mps
    return made


# Errors and tests, chosen by `benchmarks/gnss_watch.py` unless noted.
WINDOW_S = 60.0
GNSS_STD_M, GNSS_TAU_S = 3.0, 120.0
"""Least standard deviation per axis of the slowly varying error of GNSS (receivers state less), and
its correlation time."""
MAP_TAU_S, MOUNT_TAU_S = 60.0, 600.0
"""Correlation times of the map's local errors, and of the part that turns with the aircraft."""
MOUNT_SHARE, WHITE_SHARE = 0.4, 0.2
"""Fractions of the map's variance that turn with the aircraft, as from a tilted mount, and that are
independent from view to view."""
_TAUS_S = np.repeat([GNSS_TAU_S, MAP_TAU_S, MOUNT_TAU_S], 2)
"""Of the slowly varying errors, see `Difference.slow`."""
MULTIPATH_M, FAULT_SIGMAS = 8.0, 5.0
"""Change of the difference that is no fault; in addition, standard deviations from which it is."""


@dataclass(frozen=True, eq=False)
class Difference:
    """One value of the window."""

    time_s: float
    en_m: Array  # (2,): GNSS minus map
    gnss_std_m: float  # stated
    map_std_m: float
    heading_rad: float
    vel_en_mps: Array  # (2,)
    agl_m: float = 0.0  # 0 where not known, which gives it no error of the mount
    rolling_std_m: float = 0.0  # of an error of this value alone, while the aircraft rolls

    @cached_property
    def design(self) -> Array:
        return design(self.heading_rad, self.agl_m, self.vel_en_mps)

    @cached_property
    def slow(self) -> Array:
        """Derivatives (2, 6) by slowly varying errors of unit variance: of GNSS, of the map, and of
        what turns with the aircraft, two axes each."""
        sin, cos = math.sin(self.heading_rad), math.cos(self.heading_rad)
        local_std_m = math.sqrt(1 - MOUNT_SHARE - WHITE_SHARE) * self.map_std_m
        turned = math.sqrt(MOUNT_SHARE) * self.map_std_m * np.array([[cos, sin], [-sin, cos]])
        return np.hstack([self.gnss_std_m * np.eye(2), local_std_m * np.eye(2), turned])

    @property
    def white_m2(self) -> float:
        """Variance per axis of what is independent from value to value."""
        return WHITE_SHARE * self.map_std_m**2 + self.rolling_std_m**2

    def residual(self, known: Biases) -> Array:
        return self.en_m - self.design @ known.mean

    def std_m(self, known: Biases) -> float:
        """Standard deviation of the residual along the worst axis."""
        gnss_m = max(self.gnss_std_m, GNSS_STD_M)
        return math.sqrt(known.variance_m2(self.design) + gnss_m**2 + self.map_std_m**2)

    def widened(self, rolling_std_m: float) -> "Difference":
        return replace(self, rolling_std_m=max(self.rolling_std_m, rolling_std_m))


class Finding(NamedTuple):
    """A change of the difference that is a fault: when it began, and its size."""

    fault: Fault
    onset_s: float
    en_m: tuple[float, float]


def finding(values: Sequence[Difference], known: Biases) -> Finding | None:
    """The likeliest change within a window that is a fault; None without one."""
    count = len(values)
    if count < 3:
        return None
    times = np.array([each.time_s for each in values])
    changes = _changes(times)
    biased = np.concatenate([each.design for each in values])
    off = np.concatenate([each.en_m for each in values]) - biased @ known.mean
    covariance = _covariance(values, times) + biased @ known.cov @ biased.T
    columns = np.kron(np.stack([each[2] for each in changes], axis=1), np.eye(2))
    seen = columns.reshape(2 * count, -1, 2)
    weights = np.linalg.solve(covariance, columns).reshape(seen.shape)
    information = np.einsum("nka,nkb->kab", seen, weights)
    spread = np.linalg.inv(information)
    sizes = np.einsum("kab,nkb,n->ka", spread, weights, off)
    length = np.hypot(*sizes.T)
    along = np.einsum("ka,kab,kb->k", sizes, spread, sizes)
    std = np.maximum(np.sqrt(along) / np.maximum(length, 1e-9), 1e-9)
    likelihood = np.einsum("ka,kab,kb->k", sizes, information, sizes)
    likelihood[length <= MULTIPATH_M + FAULT_SIGMAS * std] = 0.0
    best = int(np.argmax(likelihood))
    if likelihood[best] == 0:
        return None
    fault, onset_s, _ = changes[best]
    east, north = sizes[best].tolist()
    return Finding(fault, float(onset_s), (east, north))


def _changes(times: Array) -> list[tuple[Fault, float, Array]]:
    """Name, onset and course (N,) of unit changes: constant, steps by values before the newest, and
    ramps by seconds, which end at 1."""
    count, now_s = len(times), times[-1]
    made = [(Fault.OFFSET, times[0], np.ones(count))]
    for age in (2, 3, 4, 5, 6, 8):
        if age < count:
            made.append((Fault.STEP, times[-age], np.repeat([0.0, 1.0], [count - age, age])))
    for age_s in (12.0, 18.0, 24.0, 32.0, 40.0, 50.0):
        if now_s - age_s >= times[0]:
            ramp = np.maximum(times - (now_s - age_s), 0.0) / age_s
            made.append((Fault.DRIFT, now_s - age_s, ramp))
    return made


def _covariance(values: Sequence[Difference], times: Array) -> Array:
    """Covariance (2 N, 2 N) of the differences without a fault and without biases."""
    slow = np.array([each.slow for each in values])
    slow[..., :2] = np.maximum(slow[..., :2], GNSS_STD_M * np.eye(2))
    alike = np.exp(-np.abs(times[:, None] - times[None])[..., None] / _TAUS_S)
    cov = np.einsum("iak,jbk,ijk->iajb", slow, slow, alike).reshape(2 * len(times), -1)
    return np.asarray(cov + np.diag(np.repeat([each.white_m2 for each in values], 2)))


LATENCY_STD_S = 0.08
"""Standard deviation of the latency of the images beyond the learnt one. With more, a step of GNSS
in a turn is named after more than 5 s; with less, images that are 0.3 s late look like steps."""


def rolling_std_m(values: Sequence[Difference], known: Biases) -> float:
    """Standard deviation of the error of the last of three values while the aircraft rolls, by the
    change of its turn rate; 0 where it does not, or values are missing or too far apart.

    `known`: for the latency that it may be due to.
    """
    if len(values) < 3:
        return 0.0
    seconds = np.diff([each.time_s for each in values])
    if not ((seconds > 0) & (seconds <= 2.0)).all():
        return 0.0
    turned = np.diff([each.heading_rad for each in values])
    before, after = np.remainder(turned + math.pi, math.tau) - math.pi
    change = float(2 * abs(after / seconds[1] - before / seconds[0]) / seconds.sum())
    if change <= math.radians(3.0):  # per second: less is noise of headings
        return 0.0
    # in a coordinated turn the tangent of the bank is speed times turn rate over gravity
    bank_rate = float(np.hypot(*values[-1].vel_en_mps)) * change / 9.81
    return math.hypot(known.mean[4], LATENCY_STD_S) * bank_rate * values[-1].agl_m


QUARANTINE_S = 180.0
"""Time that a value waits before it counts: longer than a drift of 0.25 m/s needs to be named."""
SETTLED_S = 1800.0
"""Time of agreement after which biases count as known."""
_WALK = np.array([0.02, 0.02, math.radians(0.003), math.radians(0.003), 5e-4])
"""Random walk of the biases, per root second, so that old values are forgotten over an hour: the
displacement of a map is not the same everywhere, the track corrects part of the tilt."""
_BIAS = slice(0, len(NAMES))
"""In the state of the filter, before the slowly varying errors."""


class BiasLearner:
    """Learns the biases of one receiver over one map. Mutable; deterministic."""

    def __init__(self, start: Biases, reference: Biases | None = None) -> None:
        """`reference`: of a flight that was interrupted; else it is the `start`."""
        self.waiting: deque[Difference] = deque()  # in quarantine; an alarm clears it
        self.reference = reference or start
        """What a slow drag-off of this flight has not moved: the biases before the flight, or,
        where they were not known, after the first `SETTLED_S` of agreement."""
        self.begin(start)

    def begin(self, start: Biases) -> None:
        self.learnt = start  # from all values whose quarantine has ended
        self._mean = np.concatenate([start.mean, np.zeros(len(_TAUS_S))])
        self._cov = np.eye(len(self._mean))
        self._cov[_BIAS, _BIAS] = start.cov
        self._time_s: float | None = None

    def add(self, value: Difference) -> None:
        self.waiting.append(value)
        while self.waiting and self.waiting[0].time_s <= value.time_s - QUARANTINE_S:
            self._update(self.waiting.popleft())
        if self.reference.agreed_s < SETTLED_S <= self.learnt.agreed_s:
            self.reference = self.learnt

    def restore(self) -> None:
        """Go back to the reference, if there is one: a drag-off may have been learnt since."""
        self.waiting.clear()
        if self.reference.agreed_s >= SETTLED_S:
            self.begin(self.reference)

    def until(self, time_s: float) -> Biases:
        """Estimate with the values before a time as well, though they are in quarantine."""
        ahead = copy.copy(self)  # arrays are replaced, never changed
        for value in self.waiting:
            if value.time_s < time_s:
                ahead._update(value)
        return ahead.learnt

    def _update(self, value: Difference) -> None:
        elapsed_s = 0.0 if self._time_s is None else value.time_s - self._time_s
        mean, cov = self._predicted(elapsed_s)
        shown = np.hstack([value.design, value.slow])
        spread = shown @ cov @ shown.T + value.white_m2 * np.eye(2)
        off = value.en_m - shown @ mean
        agreed_s = self.learnt.agreed_s
        if off @ np.linalg.solve(spread, off) <= 13.8:  # chi-square of two axes, 99.9 %
            gain = np.linalg.solve(spread, shown @ cov).T
            mean, cov = mean + gain @ off, cov - gain @ spread @ gain.T
            cov = (cov + cov.T) / 2
            agreed_s += min(max(elapsed_s, 0.0), 2.0)
        mean[_BIAS] = np.clip(mean[_BIAS], -LIMITS, LIMITS)
        mean[:2] *= min(1.0, LARGEST_M / max(float(np.hypot(*mean[:2])), 1.0))
        self._mean, self._cov, self._time_s = mean, cov, value.time_s
        self.learnt = Biases(mean[_BIAS], cov[_BIAS, _BIAS], agreed_s, self.learnt.setup)

    def _predicted(self, elapsed_s: float) -> tuple[Array, Array]:
        """State and covariance after a time; a clock that went back begins new slow errors."""
        elapsed_s = elapsed_s if elapsed_s >= 0 else math.inf
        kept = np.concatenate([np.ones(len(NAMES)), np.exp(-elapsed_s / _TAUS_S)])
        walked_s = elapsed_s if math.isfinite(elapsed_s) else 0.0
        grown = np.concatenate([_WALK**2 * walked_s, 1 - kept[len(NAMES) :] ** 2])
        return kept * self._mean, np.multiply.outer(kept, kept) * self._cov + np.diag(grown)
