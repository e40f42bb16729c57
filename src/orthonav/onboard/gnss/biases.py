"""Tests of the difference between GNSS and map over a window, with correlated errors.

The differences of the window are a Gaussian vector: the biases as far as they are known, and slowly
varying errors of GNSS and map. A fault adds a step or a ramp. For each onset the change is
estimated by generalized least squares and compared with its standard deviation: the generalized
likelihood ratio test of Willsky and Jones (1976, doi:10.1109/TAC.1976.1101146), over a window
instead of a recursion.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from orthonav.onboard.gnss.biases import Biases, design
from orthonav.onboard.gnss.records import Array, Fault

BIN_S = 1.0
"""Differences within this time are one value, their median."""
FINE_S, MERGED = 12.0, 3
"""Older values than this are merged, so many into one: a tenth of the work, for the same delays."""


@dataclass(frozen=True)
class DifferenceModel:
    """Parameters of errors and tests; chosen by `benchmarks/gnss_watch.py` unless noted.

    `window_s`: length of the window.
    `gnss_std_m`: least standard deviation of the slowly varying error of GNSS per axis; receivers
    state less.
    `gnss_tau_s`: its correlation time.
    `map_tau_s`: correlation time of the map's local errors.
    `mount_share`: share of the map's variance that turns with the aircraft, as from a tilted mount.
    `mount_tau_s`: correlation time of that part.
    `white_share`: share of the map's variance that is independent from view to view.
    `multipath_m`: change of the difference that is no fault.
    `sigmas`: standard deviations, in addition to `multipath_m`, from which a change is a fault.
    `step_ages`: onsets of a step, in values before the newest, less than `FINE_S`.
    `ramp_ages_s`: onsets of a ramp, in seconds before the newest value.
    """

    window_s: float = 60.0
    gnss_std_m: float = 3.0
    gnss_tau_s: float = 120.0
    map_tau_s: float = 60.0
    mount_share: float = 0.4
    mount_tau_s: float = 600.0
    white_share: float = 0.2
    multipath_m: float = 8.0
    sigmas: float = 5.0
    step_ages: tuple[int, ...] = (2, 3, 4, 5, 6, 8)
    ramp_ages_s: tuple[float, ...] = (12.0, 18.0, 24.0, 32.0, 40.0, 50.0)


@dataclass(frozen=True, eq=False)
class Difference:
    """One value of the window.

    `time_s`: time. `en_m` (2,): GNSS minus map. `gnss_std_m`, `map_std_m`: stated deviations.
    `heading_rad`: heading. `vel_en_mps` (2,): velocity. `agl_m`: height above ground; 0 where not
    known, which gives it no error of the mount. `rolling_std_m`: standard deviation of an error of
    this value alone, while the aircraft rolls. `as_stated`: whether the latency of the images is
    the stated one; one that was measured in flight has no bias to be learnt.
    """

    time_s: float
    en_m: Array
    gnss_std_m: float
    map_std_m: float
    heading_rad: float
    vel_en_mps: Array
    agl_m: float = 0.0
    rolling_std_m: float = 0.0
    as_stated: bool = True

    def rolling(self, std_m: float) -> "Difference":
        """The same with at least this error by rolling."""
        return replace(self, rolling_std_m=max(self.rolling_std_m, std_m))

    @cached_property
    def design(self) -> Array:
        """Derivatives (2, 5) by the biases."""
        return design(self.heading_rad, self.agl_m, self.as_stated * self.vel_en_mps)

    def residual(self, known: Biases) -> Array:
        """Difference (2,) that the biases do not explain."""
        return self.en_m - self.design @ known.mean


@dataclass(frozen=True)
class Finding:
    """A change of the difference that is a fault.

    `onset_s`: time at which it began. `en_m`: size. `std_m`: standard deviation along its
    direction. `excess`: by how many of them it exceeds what is no fault.
    """

    fault: Fault
    onset_s: float
    en_m: tuple[float, float]
    std_m: float
    excess: float


class DifferenceWindow:
    """Differences of the last minute and their tests. Mutable; deterministic."""

    def __init__(self, model: DifferenceModel) -> None:
        self.model = model
        self._old: deque[Difference] = deque()
        self._new: deque[Difference] = deque()

    @property
    def values(self) -> list[Difference]:
        """Values of the window in the order of time, the older ones merged."""
        return [*self._old, *self._new]

    def add(self, value: Difference) -> None:
        """Add a value; older ones than the window are dropped."""
        self._new.append(value)
        if len(self._new) > MERGED and self._new[MERGED].time_s < value.time_s - FINE_S:
            merged = [self._new.popleft() for _ in range(MERGED)]
            mean = np.mean([each.en_m for each in merged], axis=0)
            rolling_m = max(each.rolling_std_m for each in merged)
            self._old.append(replace(merged[MERGED // 2], en_m=mean, rolling_std_m=rolling_m))
        while self._old and self._old[0].time_s < value.time_s - self.model.window_s:
            self._old.popleft()

    def widen(self, rolling_std_m: float) -> None:
        """Give the newest value at least this error by rolling."""
        if self._new:
            self._new[-1] = self._new[-1].rolling(rolling_std_m)

    def clear(self) -> None:
        """Drop all values."""
        self._old.clear()
        self._new.clear()

    def recent(self, seconds: float) -> list[Difference]:
        """Values of the last seconds, less than `FINE_S`, before the newest."""
        begin = self._new[-1].time_s - seconds if self._new else 0.0
        return [each for each in self._new if each.time_s > begin]

    def finding(self, known: Biases) -> Finding | None:
        """The likeliest change that is a fault; None without one.

        `known`: what is known of the biases.
        """
        values = self.values
        count = len(values)
        if count < 3:
            return None
        times = np.array([each.time_s for each in values])
        signatures, named = self._signatures(times)
        biased = np.concatenate([each.design for each in values])
        off = np.concatenate([each.en_m for each in values]) - biased @ known.mean
        covariance = _covariance(values, self.model) + biased @ known.cov @ biased.T
        lower = cholesky(covariance, lower=True, check_finite=False)
        columns = np.kron(signatures, np.eye(2))
        stacked = np.column_stack([columns, off])
        white = solve_triangular(lower, stacked, lower=True, check_finite=False)
        seen, data = white[:, :-1].reshape(2 * count, -1, 2), white[:, -1]
        information = np.einsum("nka,nkb->kab", seen, seen)
        spread = np.linalg.inv(information)
        sizes = np.einsum("kab,nkb,n->ka", spread, seen, data)
        length = np.hypot(*sizes.T)
        along = np.einsum("ka,kab,kb->k", sizes, spread, sizes)
        std = np.sqrt(along) / np.maximum(length, 1e-9)
        excess = (length - self.model.multipath_m) / std
        likelihood = np.einsum("ka,kab,kb->k", sizes, information, sizes)
        likelihood[excess <= self.model.sigmas] = 0.0
        best = int(np.argmax(likelihood))
        if likelihood[best] == 0:
            return None
        fault, onset = named[best]
        east, north = sizes[best].tolist()
        return Finding(fault, onset, (east, north), float(std[best]), float(excess[best]))

    def _signatures(self, times: Array) -> tuple[Array, list[tuple[Fault, float]]]:
        """Unit changes (N, K): constant, steps, and ramps that end at 1; their names and onsets."""
        columns, named = [np.ones(len(times))], [(Fault.OFFSET, float(times[0]))]
        for age in self.model.step_ages:
            if age < len(times):
                columns.append((np.arange(len(times)) >= len(times) - age).astype(np.float64))
                named.append((Fault.STEP, float(times[-age])))
        for age_s in self.model.ramp_ages_s:
            onset = times[-1] - age_s
            if onset >= times[0]:
                columns.append(np.maximum(times - onset, 0.0) / age_s)
                named.append((Fault.DRIFT, float(onset)))
        return np.stack(columns, axis=1), named


def _covariance(values: Sequence[Difference], model: DifferenceModel) -> Array:
    """Covariance (2 N, 2 N) of the differences without a fault and without biases."""
    gnss, map_std, heading, rolling, times = np.array(
        [
            (each.gnss_std_m, each.map_std_m, each.heading_rad, each.rolling_std_m, each.time_s)
            for each in values
        ]
    ).T
    gnss = np.maximum(gnss, model.gnss_std_m)
    apart = np.abs(times[:, None] - times[None])
    products = np.multiply.outer(map_std, map_std)
    local_share = 1 - model.mount_share - model.white_share
    same = np.multiply.outer(gnss, gnss) * np.exp(-apart / model.gnss_tau_s)
    same += local_share * products * np.exp(-apart / model.map_tau_s)
    same += np.diag(model.white_share * map_std**2 + rolling**2)
    turned = heading[:, None] - heading[None]
    mount = model.mount_share * products * np.exp(-apart / model.mount_tau_s)
    cos, sin = mount * np.cos(turned), mount * np.sin(turned)
    blocks = np.empty((len(times), 2, len(times), 2))
    blocks[:, 0, :, 0] = blocks[:, 1, :, 1] = same + cos
    blocks[:, 0, :, 1], blocks[:, 1, :, 0] = sin, -sin
    return blocks.reshape(2 * len(times), -1)
