"""Constant biases of the difference GNSS minus map: displacement of the map, mount, latency.

The difference is linear in them: a displacement is constant, an error of the mount turns with the
heading and grows with the height, a latency acts along the velocity over ground. An error of the
mount's yaw turns the view and does not displace it, so it is none of them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthonav.core.records import MAP_STD_M
from orthonav.onboard.gnss.records import Array

NAMES = ("east_m", "north_m", "pitch_rad", "roll_rad", "latency_s")
"""Biases in the order of `Biases.mean`."""
_MOUNT = slice(2, 4)
LARGEST_M = 100.0
"""Largest displacement; a larger difference is a fault."""
LIMITS = np.array([LARGEST_M, LARGEST_M, math.radians(10), math.radians(10), 1.0])
"""Largest magnitude of each bias."""
_PRIOR_STD = np.array([30.0, 30.0, math.radians(1.5), math.radians(1.5), 0.2])
"""Assumed of a map and a camera of which nothing was learnt: a displacement of 60 m, a mount that
was aligned by eye to 3 deg and a latency of 0.4 s are 2 sigma."""
_BETWEEN_STD = np.array([0.0, 0.0, math.radians(0.3), math.radians(0.3), 0.03])
"""Change from flight to flight: a camera that was taken off, a latency that was measured again."""
PLAUSIBLE_SIGMAS = 5.0
"""A displacement beyond so many of the standard deviations that every fix includes for it
(`MAP_STD_M`) is that of a wrong map, or of a spoofed receiver."""
_LEAST_EIGENVALUE = 1e-12
_MOST_VARIANCE = 4.0
"""Of what is assumed where nothing was learnt: a larger variance is damage."""
_MOST_AGREED_S = 1e9


@dataclass(frozen=True, eq=False)
class Biases:
    """Estimated biases of GNSS minus map.

    `mean` (5,), `cov` (5, 5): in the order of `NAMES`. East and north are where the map should be,
    from where it is. Pitch and roll are errors of the reported tilt, as `Mount` has them: pitch
    positive ahead, roll positive to the left. The latency is that of the images less that of GNSS,
    positive where the images are older than assumed.
    `agreed_s`: time of agreement that they were learnt from.
    `setup`: identifies camera, mount and stated latency, for which pitch, roll and latency hold.
    """

    mean: Array
    cov: Array
    agreed_s: float = 0.0
    setup: str = ""

    @property
    def en_m(self) -> Array:
        """Displacement of the map, east and north (2,)."""
        return self.mean[:2]

    @property
    def stds(self) -> Array:
        """Standard deviations (5,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def std_m(self) -> float:
        """Standard deviation of the displacement along its worst axis."""
        return math.sqrt(float(np.linalg.eigvalsh(self.cov[:2, :2])[-1]))

    @property
    def is_plausible(self) -> bool:
        """Whether the displacement may be that of a map as accurate as fixes state."""
        largest_m = PLAUSIBLE_SIGMAS * MAP_STD_M + 2 * self.std_m
        return float(np.hypot(*self.en_m)) <= largest_m

    @property
    def is_usable(self) -> bool:
        """Whether positions may be corrected by them: the displacement is plausible, and known at
        least as well as every fix assumes it. Otherwise a constant error of a receiver could pass
        for one of the mount."""
        return self.is_plausible and self.std_m <= MAP_STD_M

    def correction(self, design: Array) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of GNSS minus map for the `design` (2, 5) of a view."""
        return design @ self.mean, design @ self.cov @ design.T

    def correction_at_any_heading(self, agl_m: float, vel_en_mps: Array) -> tuple[Array, Array]:
        """The same where all headings are equally likely: the error of the mount, which turns with
        the heading, is only part of the covariance."""
        mean, cov = self.correction(design(0.0, 0.0, vel_en_mps))
        tilt, spread = self.mean[_MOUNT], self.cov[_MOUNT, _MOUNT]
        turning_m2 = agl_m**2 * (float(tilt @ tilt) + float(np.trace(spread)))
        return mean, cov + turning_m2 / 2 * np.eye(2)

    def without_displacement(self) -> "Biases":
        """The same with no displacement, known exactly."""
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
    mean = np.array([float(each) for each in plain["mean"]])
    lower = np.array([float(each) for each in plain["cov"]])
    agreed_s, setup = float(plain["agreed_s"]), plain["setup"]
    if mean.shape != (count,) or lower.shape != (count * (count + 1) // 2,):
        raise ValueError("wrong number of values")
    if not (np.isfinite(lower).all() and (np.abs(mean) <= LIMITS).all()):
        raise ValueError("value out of range")
    if not (0 <= agreed_s <= _MOST_AGREED_S and isinstance(setup, str)):
        raise ValueError("time of agreement or setup is invalid")
    cov = np.zeros((count, count))
    cov[np.tril_indices(count)] = lower
    cov += np.tril(cov, -1).T
    scaled = cov / np.multiply.outer(_PRIOR_STD, _PRIOR_STD)
    if np.linalg.eigvalsh(scaled)[0] < _LEAST_EIGENVALUE or np.diag(scaled).max() > _MOST_VARIANCE:
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
        mean, cov, agreed_s = start.mean.copy(), start.cov.copy(), start.agreed_s
        if here is not None:
            mean[:2], cov[:2, :2], agreed_s = here.mean[:2], here.cov[:2, :2], here.agreed_s
        if same:
            mean[2:], cov[2:, 2:] = same[-1].mean[2:], same[-1].cov[2:, 2:]
        start = Biases(mean, cov, agreed_s, setup)
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
