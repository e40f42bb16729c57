"""What one view says: how likely each of its places is, and whether it shows the map there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthonav.core.localize.sighting import Sighting
from orthonav.core.track.model import (
    COMMON,
    HEADING_FLOOR_RAD,
    SCALE_FLOOR,
    SEEN,
    WHITE_SHARE,
    Array,
    Model,
    ReportedAttitude,
)

LEAST_NEW = 0.15
"""Of a view, however it overlaps: noise, light and tilt differ (docs/tracking.md)."""
ROUNDING = 1e-7  # of variances: where a view shows less than its camera, rounding has no root
POSE = slice(2, 4)
SEARCHED_SIGMAS = 6.0  # width of the search over heading and scale, from end to end
MAX_LOG_ODDS = 7.0  # of a single view


@dataclass(frozen=True, eq=False)
class Measurement:
    """A sighting as a measurement of `model.SEEN`: `mean` (6,).

    `noise` (6, 6): tempered. `log_odds`: over the density of what only looks alike. `independent`
    (6, 6): not in common with views of the same ground. `seen` (6, 16): what it measures.
    `single_view_probability`: of the place, by the view without the track. `log_chance`: log
    density of chance in the area searched."""

    mean: Array
    noise: Array
    log_odds: float
    independent: Array
    seen: Array
    single_view_probability: float
    log_chance: float


def measurement(
    model: Model, reported: ReportedAttitude, sighting: Sighting
) -> tuple[Array, Array, Array]:
    """Mean (6,), covariances (6, 6) of map and view, and of telemetry noise, new at each view."""
    noise = sighting.covariance.copy()
    floor = [model.sighting_noise_m] * 2 + [HEADING_FLOOR_RAD, SCALE_FLOOR]
    noise[range(4), range(4)] += np.square(floor)
    white = WHITE_SHARE * model.horizon_rad
    independent = np.diag(np.square([0.0, 0.0, 0.0, 0.0, white, white]))
    seen = sighting.mean.copy()
    if reported.heading_rad is None:
        seen[2] = 0.0
        noise[2, :] = noise[:, 2] = 0.0
        noise[2, 2] = math.pi**2
    else:
        seen[2] = math.remainder(seen[2] - reported.heading_rad, 2 * math.pi)
    seen[4:] -= [reported.pitch_rad, reported.roll_rad]
    return seen, noise, independent


def updated(mean: Array, covariance: Array, measured: Measurement) -> tuple[Array, Array]:
    """Kalman update of states (.., 16), (.., 16, 16)."""
    spread = measured.seen @ covariance @ measured.seen.T + measured.independent
    gain = np.linalg.solve(spread, measured.seen @ covariance).swapaxes(-1, -2)
    after = covariance - gain @ spread @ gain.swapaxes(-1, -2)
    moved = mean + (gain @ (measured.mean - mean @ measured.seen.T)[..., None])[..., 0]
    return moved, (after + after.swapaxes(-1, -2)) / 2


def log_densities(off: Array, spread: Array) -> Array:
    """Of Gaussians (.., N, N) at `off` (.., N)."""
    _, log_det = np.linalg.slogdet(2 * math.pi * spread)
    weighted = np.linalg.solve(spread, off[..., None])[..., 0]
    return np.asarray(-0.5 * ((off * weighted).sum(axis=-1) + log_det))


def log_density(off: Array, spread: Array) -> float:
    return float(log_densities(off, spread))


def tempered(
    model: Model,
    mounts: Sequence[tuple[float, Array]],
    areas_m2: tuple[float, float],
    reported: ReportedAttitude,
    sighting: Sighting,
    newness: float,
) -> Measurement:
    """A sighting as a measurement, tempered by the fraction of it that is new.

    `mounts`: probability and covariance (16, 16) of the initial state of each kind. `areas_m2`: of
    the map, and of the part searched. A likelihood to the power `newness` has a broader peak; the
    telemetry noise, independent at every view, is excluded."""
    mean, noise, independent = measurement(model, reported, sighting)
    map_m2, searched_m2 = areas_m2
    own = np.diag(noise)[POSE] + model.initial_bias()[:2]
    poses = float(np.log(SEARCHED_SIGMAS * np.sqrt(own)).sum())
    wide = math.log(map_m2) + poses
    # Tilts are distributed as those of mounts at every place: no evidence for one.
    tilts = noise[4:, 4:] + independent[4:, 4:]
    wide -= float(
        np.logaddexp.reduce(
            [
                math.log(share) + log_density(mean[4:], tilts + (SEEN @ each @ SEEN.T)[4:, 4:])
                for share, each in mounts
            ]
        )
    )
    _, log_det = np.linalg.slogdet(2 * math.pi * (noise + independent))
    odds = newness * (min(sighting.log_odds, MAX_LOG_ODDS) + wide)
    odds += (1 - newness) * float(log_det) / 2 - len(mean) / 2 * math.log(newness)
    seen = SEEN.copy()
    spread = (noise + noise.T) / 2 + ROUNDING * np.diag(np.diag(noise))
    seen[:, COMMON] = np.linalg.cholesky((1 - LEAST_NEW) * spread)
    return Measurement(
        mean,
        noise / newness + independent,
        odds,
        LEAST_NEW * noise + independent,
        seen,
        sighting.single_view_probability,
        -math.log(searched_m2) - poses,
    )


def recognition(
    seen: Measurement, covariances: Array, innovations: Array, most_agreement: float
) -> Array:
    """Probabilities (K,) that a view showed the map, given its place and predictions of that.

    The odds by the view alone, times the likelihood ratio of innovations (K, 6), of predictions
    with `covariances` (K, 6, 6), between a right place and one that chance finds in the area
    searched, at most `most_agreement`. A place within the gate is never less likely for its
    distance."""
    common = seen.seen[:4, COMMON]
    spreads = covariances[:, :4, :4] + common @ common.T + seen.independent[:4, :4]
    ratios = log_densities(innovations[:, :4], spreads) - seen.log_chance
    agreement = np.exp(np.clip(ratios, 0.0, math.log(most_agreement)))
    odds = seen.single_view_probability / max(1 - seen.single_view_probability, 1e-9) * agreement
    return np.asarray(odds / (1 + odds))
