"""The camera of a placed view: position, height, heading, pitch and roll from the picture.

Blocks of the view say how well they fit the map a little aside (`orthonav.core.register.blocks`).
The camera is the maximum of their posterior with the telemetry, by Newton's method; changed ground
is an outlier of a mixture. Then the view is orthorectified one level finer, and fitted again."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.ground import LevelTerrain, Relief, ViewOverGround
from orthonav.core.localize.rectify import Orientation, is_oblique
from orthonav.core.records import DEFAULT_TILT_STD_DEG, Telemetry
from orthonav.core.register.blocks import BlockScores, block_scores
from orthonav.core.register.pose import Pose
from orthonav.core.register.template import BLOCKS, ViewTemplates
from orthonav.core.register.window import Reference

STEPS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Of numerical derivatives: metres east, north, up, degrees of heading, pitch, roll."""
GROUND_STEP_M = 2.0  # of a point along the ground: the noise of a terrain model over its slope
BLURS_PX = (2.0, 1.0, 0.0, 0.0)
"""Gaussian blur of correlations at each step: wide peaks first, for views off by some pixels."""
SHARP_PX = (0.7, 0.0)  # the same from a correction by `SAMPLE` blocks, or from one close by
SAMPLES, SAMPLE, SAMPLE_STD_PX = 200, 3, 1.0
"""Corrections tried by the peaks of a few blocks, known to so many pixels (RANSAC)."""
FINAL_STEPS = 2  # after the blocks' information was compared with the scatter of their slopes
LONGEST_STEP_PX = 3.0  # of any block, per step
PIXELS_PER_NUMBER = 5.0  # pixels per independent number; only the odds of outliers depend on it
LEAST_CORRELATION, MOST_CORRELATION = 0.03, 0.9  # limits of the mean correlation of a right block
CORRELATED, CORRELATED_PX = 2.0, 60.0
"""Errors of levels and dates correlate: least excess of the variance over the scatter of blocks,
and what errors reach over, pixels of the map (docs/decisions/camera.md)."""
MIN_BLOCKS = 8
WEAK = np.array([1e4, 1e4, 1e3, 60.0, 20.0, 20.0])
"""Standard deviations of a camera of which nothing is reported."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resection:
    """Corrections (6,), m east, north, up, deg heading, pitch, roll, and covariances (6, 6).

    `alone`: by the blocks without telemetry, as far as they show it (`WEAK`). `information` (6, 6):
    that of the telemetry."""

    correction: Array
    covariance: Array
    alone: Array
    alone_covariance: Array
    information: Array


def resected(
    seen: Sequence[tuple[BlockScores, Array]],
    prior: tuple[Array, Array],
    *,
    block_px: float,
    close: bool = False,
) -> Resection | None:
    """The camera under which the blocks of a view fit the map best; None where too few are seen.

    `seen`: per level the blocks and how far (N, 2, 6) each moves, pixels right and down, by the
    camera. `prior`: correction (6,) and information (6, 6). `close`: the camera is known to a pixel
    or two."""
    correlated = max(CORRELATED, 1 + (CORRELATED_PX / block_px) ** 2)
    blocks = _Blocks.of(seen, correlated)
    if blocks is None:
        return None
    correction = blocks.climbed(np.zeros(6), SHARP_PX if close else BLURS_PX, prior)
    if not close:
        sampled = blocks.best(blocks.sampled(prior), prior)
        ascents = [correction, blocks.climbed(sampled, SHARP_PX, prior)]
        correction = blocks.best(np.stack(ascents), prior)
    curvature, slopes = blocks.system(correction)
    inverse = np.linalg.pinv(curvature, hermitian=True)
    spread = slopes.T @ slopes * (blocks.seen / max(blocks.seen - 6, 1))
    excess = max(1.0, correlated * float(np.trace(inverse @ spread)) / 6)
    for _ in range(FINAL_STEPS):
        correction = blocks.stepped(correction, 0.0, excess, prior)
    mean, information = prior
    curvature = blocks.system(correction)[0] / excess
    covariance = np.linalg.inv(curvature + information)
    # Without the telemetry's share: where the quadratic of the blocks alone has its peak.
    alone_covariance = np.linalg.inv(curvature + np.diag(WEAK**-2))
    alone = correction + alone_covariance @ information @ (correction - mean)
    if not all(np.isfinite(each).all() for each in (correction, covariance, alone_covariance)):
        return None
    return Resection(
        correction,
        np.asarray(covariance),
        np.asarray(alone),
        np.asarray(alone_covariance),
        information,
    )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Of all levels: correlations (L * N, S, S), pixels (L * N,), moves (L * N, 2, 6)."""

    levels: int
    correlated: float
    correlations: Array
    pixels: Array
    moved: Array

    @classmethod
    def of(cls, seen: Sequence[tuple[BlockScores, Array]], correlated: float) -> "_Blocks | None":
        moved = np.concatenate([each for _, each in seen])
        known = np.isfinite(moved).all(axis=(1, 2))
        pixels = np.where(known, np.concatenate([scores.pixels for scores, _ in seen]), 0.0)
        if (pixels.reshape(len(seen), -1) > 0).sum(axis=1).max() < MIN_BLOCKS:
            return None
        correlations = np.concatenate([scores.correlations for scores, _ in seen])
        moved = np.where((pixels > 0)[:, None, None], moved, 0.0)
        return cls(len(seen), correlated, correlations, pixels, moved)

    def sampled(self, prior: tuple[Array, Array]) -> Array:
        """Corrections (S, 6) by the peaks of a few blocks each, chosen by how high these are."""
        mean, information = prior
        count, side = len(self.pixels), self.correlations.shape[1]
        flat = self.correlations.reshape(count, -1)
        highest = flat.argmax(axis=1)
        peaks_px = np.stack([highest % side, highest // side], axis=-1) - side // 2
        height = np.maximum(flat.max(axis=1), 0.0)
        with np.errstate(divide="ignore"):
            chance = np.log(self._weights(self._usual(height)) * height)
        drawn = np.random.default_rng(0).gumbel(size=(SAMPLES, count)) + chance
        chosen = np.argpartition(-drawn, SAMPLE, axis=1)[:, :SAMPLE]
        moved = self.moved[chosen].reshape(SAMPLES, 2 * SAMPLE, 6)
        peaks = peaks_px[chosen].reshape(SAMPLES, 2 * SAMPLE)
        known = moved.swapaxes(1, 2) / SAMPLE_STD_PX**2
        right = np.einsum("spk,sk->sp", known, peaks) + information @ mean
        return np.asarray(np.linalg.solve(known @ moved + information, right[..., None])[..., 0])

    @property
    def seen(self) -> int:
        return int((self.pixels.reshape(self.levels, -1) > 0).any(axis=0).sum())

    def climbed(self, start: Array, blurs_px: Sequence[float], prior: tuple[Array, Array]) -> Array:
        """A maximum of the posterior near a correction."""
        correction = start
        for blur_px in blurs_px:
            correction = self.stepped(correction, blur_px, 1.0, prior)
        return correction

    def best(self, corrections: Array, prior: tuple[Array, Array]) -> Array:
        mean, information = prior
        moved = (self.moved.reshape(-1, 6) @ corrections.T).T.reshape(len(corrections), -1, 2)
        here = _values(self.correlations, moved)
        usual = self._usual(here).max(axis=0)
        fit = (
            np.logaddexp(0.0, self._weights(usual) * (here - usual / 2)).sum(axis=1)
            / self.correlated
        )
        off = corrections - mean
        prior_nats = np.einsum("sp,pq,sq->s", off, information, off) / 2
        return np.asarray(corrections[int(np.argmax(fit - prior_nats))])

    def _usual(self, correlations: Array) -> Array:
        """Mean correlation (.., L * N) of the level."""
        by_level = (*correlations.shape[:-1], self.levels, -1)
        weighted = (correlations * self.pixels).reshape(by_level).sum(axis=-1)
        pixels = self.pixels.reshape(self.levels, -1).sum(axis=1)
        usual = weighted / np.maximum(pixels, 1.0)
        usual = np.minimum(np.maximum(usual, LEAST_CORRELATION), MOST_CORRELATION)
        return np.repeat(usual, len(self.pixels) // self.levels, axis=-1)

    def _weights(self, usual: Array) -> Array:
        """Log likelihood ratio (L * N,) per unit of correlation, of a right block against none."""
        return usual / (1 - usual**2) * self.pixels / PIXELS_PER_NUMBER

    def stepped(
        self, correction: Array, blur_px: float, excess: float, prior: tuple[Array, Array]
    ) -> Array:
        """One step of Newton's method; the blocks say less by `excess`."""
        mean, information = prior
        curvature, slopes = self.system(correction, blur_px)
        pull = slopes.sum(axis=0) / excess + information @ (mean - correction)
        step = np.linalg.solve(curvature / excess + information, pull)
        longest = float(np.hypot(*(self.moved @ step).T).max())
        return np.asarray(correction + step * min(1.0, LONGEST_STEP_PX / max(longest, 1e-9)))

    def system(self, correction: Array, blur_px: float = 0.0) -> tuple[Array, Array]:
        """Curvature (6, 6) of the log likelihood, and its slope (N, 6) by each block."""
        here, slope, curvature = _quadratic(
            _blurred(self.correlations, blur_px), self.moved @ correction
        )
        usual = self._usual(here)
        weight = self._weights(usual)
        odds = np.clip(weight * (here - usual / 2), -30.0, 30.0)
        weight = weight / (1 + np.exp(-odds))
        terms = ((slope * weight[:, None])[:, None] @ self.moved)[:, 0]
        held = (curvature * weight[:, None, None]) @ self.moved
        total = self.moved.reshape(-1, 6).T @ held.reshape(-1, 6)
        return total, terms.reshape(self.levels, -1, 6).sum(axis=0)


def _blurred(correlations: Array, blur_px: float) -> Array:
    if blur_px == 0:
        return correlations
    at = np.arange(correlations.shape[1])
    kernel = np.exp(-((at[:, None] - at) ** 2) / (2 * blur_px**2))
    kernel /= kernel.sum(axis=1, keepdims=True)
    return np.asarray(kernel @ correlations @ kernel.T)


def _quadratic(surfaces: Array, moved_px: Array) -> tuple[Array, Array, Array]:
    """Values (N,), slopes (N, 2), curvatures (N, 2, 2) >= 0 of surfaces (N, S, S) at (N, 2) x, y.

    By the quadratic through the pixels around; 0 beyond the surface."""
    reach = surfaces.shape[1] // 2
    inside = (np.abs(moved_px) <= reach).all(axis=1)
    held = np.clip(moved_px, 1 - reach, reach - 1)
    nearest = np.rint(held)
    x, y = (nearest.astype(int) + reach).T
    rows = np.arange(len(surfaces))

    def at(right: int, down: int) -> Array:
        return np.asarray(surfaces[rows, y + down, x + right])

    here = at(0, 0)
    slope = np.stack([at(1, 0) - at(-1, 0), at(0, 1) - at(0, -1)], axis=-1) / 2
    along = 2 * here - at(1, 0) - at(-1, 0)
    down = 2 * here - at(0, 1) - at(0, -1)
    across = (at(1, -1) + at(-1, 1) - at(1, 1) - at(-1, -1)) / 4
    curvature = np.stack([along, across, across, down], axis=-1).reshape(-1, 2, 2)
    off = np.clip(moved_px - nearest, -1.0, 1.0)
    bent = (curvature @ off[..., None])[..., 0]
    value = here + ((slope - bent / 2) * off).sum(axis=1)
    slope = slope - bent
    return value * inside, slope * inside[:, None], _positive(curvature) * inside[:, None, None]


def _values(surfaces: Array, moved_px: Array) -> Array:
    """Of surfaces (N, S, S) at the pixel nearest to displacements (.., N, 2), else 0."""
    reach = surfaces.shape[-1] // 2
    nearest = np.rint(np.minimum(np.maximum(moved_px, -reach), reach)).astype(int) + reach
    values = surfaces[np.arange(len(surfaces)), nearest[..., 1], nearest[..., 0]]
    return np.asarray(values * (np.abs(moved_px) <= reach).all(axis=-1))


def _positive(matrices: Array) -> Array:
    """Symmetric matrices (N, 2, 2) with negative eigenvalues set to 0."""
    half = (matrices[:, 0, 0] + matrices[:, 1, 1]) / 2
    apart = np.hypot((matrices[:, 0, 0] - matrices[:, 1, 1]) / 2, matrices[:, 0, 1])
    # Between an ellipse and a saddle only the larger one is left: its projection.
    whole, none = half >= apart, half <= -apart
    scale = np.where(whole, 1.0, (half + apart) / np.maximum(2 * apart, 1e-30))
    shift = np.where(whole, 0.0, apart - half)
    out = scale[:, None, None] * (matrices + shift[:, None, None] * np.eye(2))
    return np.asarray(np.where(none[:, None, None], 0.0, out))


def moved_by_camera(
    camera: Camera, orientation: Orientation, ground_m: Array, slopes: Array
) -> Array:
    """Metres (N, 2, 6) by which an image point moves over the ground per unit of the camera; NaN
    where not seen. `ground_m` (N, 3): east, north, above sea; `slopes` (N, 2): its rise."""
    by_ground = []
    for axis in range(2):
        step = np.zeros((len(ground_m), 3))
        step[:, axis] = GROUND_STEP_M
        step[:, 2] = slopes[:, axis] * GROUND_STEP_M
        ahead, behind = (orientation.seen_px(camera, ground_m + sign * step) for sign in (1, -1))
        by_ground.append((ahead - behind) / (2 * GROUND_STEP_M))
    by_camera = []
    for axis in range(6):
        change = np.zeros(6)
        change[axis] = STEPS[axis]
        ahead, behind = (
            orientation.moved(sign * change).seen_px(camera, ground_m) for sign in (1, -1)
        )
        by_camera.append((ahead - behind) / (2 * STEPS[axis]))
    on_ground = np.stack(by_ground, axis=-1)
    bad = ~np.isfinite(on_ground).all(axis=(1, 2))
    on_ground[bad] = np.eye(2)
    moved = -np.linalg.solve(on_ground, np.stack(by_camera, axis=-1))
    moved[bad] = np.nan
    return np.asarray(moved)


FIRST_REACH_PX, REACH_PX = 7, 4
"""Reach, pixels of the level: 7 px are 10 deg of tilt at the rim of a view 65 deg wide."""
FITS = 3  # at most,
SMALL_SHARE = 0.2  # until a correction is below this fraction of its standard deviations
VARIANCE, VARIANCE_POWER, LEAST_RATIO = 1.6, -0.8, 0.5
"""Variance of the errors of blocks over what their curvature says: the first, times the local ratio
of the place (at least the third) to the power of the second (docs/decisions/camera.md)."""


@dataclass(frozen=True, eq=False)
class CameraFound:
    """The camera of a view; `agl_m`: above the ground below it; `alone`: without telemetry.

    - covariances (6, 6): m east, north, up, deg heading, pitch, roll; `WEAK` where not shown.
    - `variance`: of the errors of blocks over what their curvature says.
    - `middle_en_m`, `middle_covariance` (2, 2): ground in the middle of the picture, None: unknown.
    """

    orientation: Orientation
    agl_m: float
    covariance: Array
    alone: Orientation
    alone_covariance: Array
    variance: float
    middle_en_m: tuple[float, float]
    middle_covariance: Array | None


def camera_found(
    seen: ViewOverGround, reference: Reference, pose: Pose, local_ratio: float
) -> CameraFound | None:
    """Of a view at `pose`; None where the tilt is exact or too few blocks are seen.

    `local_ratio`: of the scores of the place."""
    if tilt_std_deg(seen.view.telemetry) == 0:
        return None
    if math.isnan(seen.reference_m(pose)):  # it was placed on level ground
        seen = ViewOverGround(Relief(LevelTerrain(), seen.relief.grid), seen.view)
    orientation, start = seen.orientation(pose), None
    if orientation is None:
        return None
    found: Resection | None = None
    for number in range(FITS):
        start = orientation
        found = _fitted(seen, reference, pose, start, first=number == 0)
        if found is None:
            return None
        orientation = start.moved(found.correction)
        small = np.abs(found.correction) < SMALL_SHARE * np.sqrt(np.diag(found.covariance))
        if number > 0 and small.all():
            break
    assert found is not None and start is not None
    east, north, above_sea_m = orientation.position_m.tolist()
    agl_m = above_sea_m - float(seen.relief.terrain.at_en_m([east, north]))
    if not agl_m > 0:
        return None
    variance = VARIANCE * max(local_ratio, LEAST_RATIO) ** VARIANCE_POWER
    covariance = _scaled(found.covariance, found.information, variance)
    return CameraFound(
        orientation,
        agl_m,
        covariance,
        start.moved(found.alone),
        _scaled(found.alone_covariance, np.diag(WEAK**-2), variance),
        variance,
        seen.middle_en_m(orientation, pose),
        _middle_covariance(seen, orientation, covariance),
    )


def _scaled(covariance: Array, information: Array, variance: float) -> Array:
    """With so many times the variance of all that is not the prior's `information` (6, 6)."""
    return variance * covariance + (1 - variance) * covariance @ information @ covariance


def tilt_std_deg(telemetry: Telemetry) -> float:
    stated = telemetry.tilt_std_deg
    return DEFAULT_TILT_STD_DEG if stated is None else stated


def _fitted(
    seen: ViewOverGround, reference: Reference, pose: Pose, orientation: Orientation, *, first: bool
) -> Resection | None:
    """A correction: the first at the final level and a coarser one, then one finer too."""
    final = seen.view.levels.final
    finest = final if first else max(final - 1, 0)
    made = _templates(seen, pose, finest, orientation, first=first)
    if made is None:
        return None
    reach_px = FIRST_REACH_PX if first else REACH_PX
    coarsest = min(final + 1, reference.levels - 1)
    levels = [at for at in range(finest, coarsest + 1) if min(made.shape(at)) >= BLOCKS]
    if not levels:
        return None
    blocks = [block_scores(made.at(each), reference, pose, reach_px) for each in levels]
    camera = seen.view.picture_at(finest).camera
    ground = seen.relief.ground_m(pose.map_px(blocks[0].middles_px * 2.0**finest))
    moved_m = moved_by_camera(camera, orientation, ground, seen.relief.slopes(ground))
    window_from_en = np.linalg.inv(pose.linear) @ np.diag([1.0, -1.0]) / seen.relief.grid.gsd_m
    moved_px = window_from_en @ moved_m
    return resected(
        [(each, moved_px / 2.0**level) for each, level in zip(blocks, levels, strict=True)],
        _prior(seen, pose, orientation),
        block_px=seen.view.side_px / BLOCKS,
        close=not first,
    )


def _templates(
    seen: ViewOverGround, pose: Pose, level: int, orientation: Orientation, *, first: bool
) -> ViewTemplates | None:
    """Rectified under an orientation; over level ground the first is the search's."""
    if first and seen.relief.is_level and not is_oblique(seen.view.view):
        return seen.view.templates
    return seen.templates_at(pose, level, orientation)


def _middle_covariance(
    seen: ViewOverGround, orientation: Orientation, covariance: Array
) -> Array | None:
    """Of the ground (2, 2), m2, that the middle of a view shows; None beside unknown ground."""
    columns = []
    for step in np.diag(STEPS):
        ahead, behind = (seen.sight_en_m(orientation.moved(sign * step)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step.sum()))
    slopes = np.stack(columns, axis=1)
    return slopes @ covariance @ slopes.T if np.isfinite(slopes).all() else None


def _prior(seen: ViewOverGround, pose: Pose, orientation: Orientation) -> tuple[Array, Array]:
    """Expected correction (6,) by telemetry, and its information (6, 6)."""
    telemetry, prior = seen.view.telemetry, seen.view.prior
    expected, std = 0.0, prior.log_scale_std
    if prior.scale_map is not None:
        expected, std = prior.scale_map.at(pose.x_px, pose.y_px), prior.scale_map.std
    expected_m = seen.reference_m(pose) + telemetry.agl_m * math.exp(expected)
    up_m = expected_m - float(orientation.position_m[2])
    turn = math.degrees(prior.turn_rad or 0.0) - orientation.attitude_deg[0]
    tilt = np.array([telemetry.pitch_deg, telemetry.roll_deg]) - orientation.attitude_deg[1:]
    mean = np.array([0.0, 0.0, up_m, math.remainder(turn, 360.0), *tilt.tolist()])
    tilt_std = max(tilt_std_deg(telemetry), 1e-3)
    stds = np.array([1e4, 1e4, telemetry.agl_m * std, 180.0, tilt_std, tilt_std])
    if prior.turn_rad is not None:
        stds[3] = math.degrees(prior.turn_std_rad)
    else:
        mean[3] = 0.0
    return mean, np.diag(stds**-2)
