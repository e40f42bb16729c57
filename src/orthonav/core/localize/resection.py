"""The camera under which the blocks of a view fit the map best, by resection.

Blocks say how well they fit the map a little aside (`orthonav.core.register.refine.block_scores`).
The camera and the systematic errors of the blocks are the maximum of their posterior with the
telemetry, by Newton's method; changed ground is an outlier of a mixture. The size of the systematic
errors and of the noise is estimated too (variance components, Koch 1999).

Systematic errors displace blocks together, and are not the camera: heights of the ground that the
map does not know, houses and trees, a nominal lens, and imagery of two dates that is stretched. A
slope of the ground displaces blocks as a tilt of the camera does. Each is Gaussian; they are solved
for with the camera and marginalized."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.ground import relief_slope
from orthonav.core.mapfile.manifest import TerrainInfo
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.refine import BlockScores

Array = NDArray[np.float64]
Field = tuple[float, float]
"""A random field: standard deviation and correlation length, both m or both pixels."""


@dataclass(frozen=True)
class ErrorModel:
    """Sizes of the errors; values without a source are in docs/decisions/camera.md."""

    objects_m: Field = (3.0, 15.0)
    """Houses and trees: 6 to 8 m high on a fifth of the ground."""
    surface_m: Field = (0.5, 10.0)
    """A surface model, whose houses and trees are those of another date."""
    bare_earth_m: Field = (0.5, 50.0)
    """Bare earth of laser scanning or photogrammetry, 0.1 to 0.5 m."""
    coarse_std_m: float = 6.0
    coarse_posting_m: float = 30.0
    """Copernicus GLO-30 and its like on slopes, and their posting. Finer models err by less,
    coarser ones by more: the slope of the error stays."""
    std_per_slope_m: float = 100.0
    """Standard deviation over the root mean square slope of the terrain, which its errors add to;
    of coarser models in proportion."""
    coarse_length_m: float = 150.0
    max_coarser: float = 8.0
    """Correlation length of these errors, in proportion to the posting up to a multiple at which
    they are longer than any view; at least that of bare earth."""
    rough_m: float = 1.0
    rough_per_slope_m: float = 4.0
    """Terrain as rough within a sample shows houses and trees; steep bare earth is rough too."""
    undulation_m: Field = (50.0, 100.0)
    """Of unknown ground, and what a terrain of a posting above 50 m leaves out: standard deviation
    over the slope, and correlation length."""
    stretch_px: Field = (0.3, 80.0)
    """Of imagery of two dates, pixels of the map: as residuals of blocks show."""
    min_mode: float = (
        1e-3  # weaker modes of a field, of the variance of its strongest, are left out
    )
    min_known: float = 0.1
    min_unknown: float = 0.7
    """Least factors on the variance of errors by what a view shows: ground that does not undulate
    may still slope."""
    centre_share: float = 0.01
    distortion: float = 0.05
    """Of a nominal lens: principal point over the width, and first radial coefficient."""


ERRORS = ErrorModel()


@dataclass(frozen=True)
class GroundErrors:
    """Errors of the heights that are assumed under a view.

    `slope`: standard deviation of its unknown slope, per axis (rise over run). `shift`: of its
    picture on the map, per axis."""

    slope: float
    fields: tuple[Field, ...]
    shift: Field | None = None


def unknown_ground(relief: str | None) -> GroundErrors:
    """Errors of assumed flat ground; `relief`: what the land is like, None: nobody said."""
    slope = relief_slope(relief)
    per_slope_m, length_m = ERRORS.undulation_m
    return GroundErrors(slope / math.sqrt(2), ((per_slope_m * slope, length_m), ERRORS.objects_m))


def surface_errors(lean_std: float, above_m: Array) -> GroundErrors:
    """Errors of a map that knows houses and trees, `above_m` (N,) above its terrain under a view,
    NaN where unknown, which lean in its picture by more or less than known."""
    high_m = math.sqrt(float(np.nanmean(above_m**2)))
    shift = (lean_std * high_m, ERRORS.surface_m[1]) if lean_std * high_m > 0 else None
    return GroundErrors(0.0, (ERRORS.surface_m,), shift)


def terrain_errors(source: TerrainInfo | None, slopes: Array) -> GroundErrors:
    """Errors of a map's terrain with slopes (N, 2) under a view, NaN where unknown.

    `source`: None: a terrain like Copernicus'."""
    known = slopes[np.isfinite(slopes).all(axis=1)]
    steep = math.sqrt(float((known**2).sum(axis=1).mean())) if len(known) else math.inf
    posting_m = ERRORS.coarse_posting_m
    if source is not None:
        posting_m = source.source_posting_m or source.posting_m
        rough_m = source.roughness_m or 0.0
        if rough_m > max(
            ERRORS.rough_m, ERRORS.rough_per_slope_m * steep
        ):  # houses and trees, smoothed
            return GroundErrors(0.0, (ERRORS.surface_m, (rough_m, ERRORS.objects_m[1])))
    least_m, least_length_m = ERRORS.bare_earth_m
    coarser = min(posting_m / ERRORS.coarse_posting_m, ERRORS.max_coarser)
    most_m = max(ERRORS.coarse_std_m * coarser, least_m)
    std_m = min(max(ERRORS.std_per_slope_m * max(coarser, 1.0) * steep, least_m), most_m)
    fields = [(std_m, max(ERRORS.coarse_length_m * coarser, least_length_m))]
    per_slope_m, length_m = ERRORS.undulation_m
    if length_m < 2 * posting_m:
        fields.append((min(per_slope_m * steep, most_m), length_m))
    return GroundErrors(0.0, (*fields, ERRORS.objects_m))


class Component(NamedTuple):
    """Errors whose common variance the view itself shows, and the least factor on it."""

    at: slice
    least: float


class Systematic(NamedTuple):
    """Displacements of blocks (N, 2, K), pixels right and down at level 0, by one standard
    deviation of each error; `slope_rad`: standard deviation of the slope among them."""

    moves_px: Array
    components: tuple[Component, ...]
    slope_rad: float


def systematic(
    errors: GroundErrors,
    *,
    places_m: Array,
    by_height_px: Array,
    by_lens_px: Array | None,
    block_px: float,
    gsd_m: float,
) -> Systematic:
    """Displacements of blocks `block_px` wide at places (N, 2) on the ground, m.

    They move by `by_height_px` (N, 2) per metre of height, and by `by_lens_px` (N, 2, L) per
    standard deviation of each error of the lens; None: it is calibrated."""
    heights_m = [field_modes(places_m, field, block_px * gsd_m) for field in errors.fields]
    least = [ERRORS.min_known] * len(heights_m)
    if errors.slope > 0:
        sloped_m = errors.slope * (places_m - places_m.mean(axis=0))
        heights_m[0] = np.concatenate([sloped_m, heights_m[0]], axis=1)
        least[0] = ERRORS.min_unknown
    moves_px = [by_height_px[:, :, None] * each[:, None] for each in heights_m]
    on_map = [ERRORS.stretch_px]
    if errors.shift is not None:
        on_map.append((errors.shift[0] / gsd_m, errors.shift[1] / gsd_m))
    for each in on_map:
        along_px = field_modes(places_m / gsd_m, each, block_px)
        none_px = np.zeros(along_px.shape)
        both_px = [[along_px, none_px], [none_px, along_px]]
        moves_px.append(np.concatenate([np.stack(axis, axis=1) for axis in both_px], axis=2))
    least += [ERRORS.min_known] * len(on_map)
    ends = np.cumsum([each.shape[2] for each in moves_px]).tolist()
    components = tuple(
        Component(slice(start, end), low)
        for start, end, low in zip([0, *ends[:-1]], ends, least, strict=True)
    )
    if by_lens_px is not None:
        moves_px.append(by_lens_px)
    return Systematic(np.concatenate(moves_px, axis=2), components, errors.slope)


def lens_px(camera: Camera, seen_px: Array) -> Array:
    """By which a nominal lens displaces points of the picture (N, 2), (N, 2, 4): its principal
    point, focal length and radial distortion, by one standard deviation of each."""
    off_px = seen_px - [camera.cx_px, camera.cy_px]
    square = (off_px**2).sum(axis=1, keepdims=True) / camera.fx_px**2
    centre_px = np.full(len(seen_px), ERRORS.centre_share * camera.width_px)
    right_px, down_px = (np.outer(centre_px, axis) for axis in np.eye(2))
    scaled_px, bent_px = off_px * camera.focal_std, off_px * (ERRORS.distortion * square)
    return np.stack([right_px, down_px, scaled_px, bent_px], axis=2)


def field_modes(places: Array, field: Field, block: float) -> Array:
    """Values (N, K) of a random field with a Gaussian covariance, mean over blocks at places
    (N, 2), by one standard deviation of each of its modes. All in one unit."""
    squares = ((places[:, None] - places) ** 2).sum(axis=-1)
    std, length = field
    # The mean over a square block is that over a Gaussian with the same second moments.
    wide = length**2 + block**2 / 6
    covariance = std**2 * length**2 / wide * np.exp(-squares / (2 * wide))
    values, vectors = np.linalg.eigh(covariance)
    used = values > ERRORS.min_mode * values[-1]
    return np.asarray(vectors[:, used] * np.sqrt(values[used]))


CAMERA = slice(0, 6)
WEAK = np.array([1e4, 1e4, 1e3, 60.0, 20.0, 20.0])
"""Standard deviations of a camera of which nothing is reported."""


@dataclass(frozen=True)
class Solver:
    """How the posterior is climbed; reasons are in docs/decisions/camera.md."""

    blurs_px: tuple[float, ...] = (2.0, 1.0, 0.0, 0.0)
    """Gaussian blur of correlations at each step: wide peaks first, for views pixels off."""
    sharp_px: tuple[float, ...] = (0.7, 0.0)
    """The same from a correction by `sample` blocks, or from one close by."""
    samples: int = 200  # corrections tried by the peaks
    sample: int = 3  # of so many blocks (RANSAC),
    sample_std_px: float = 1.0  # known to so many pixels
    joint_steps: int = 6  # of camera and systematic errors together
    longest_step_px: float = 3.0  # of any block, per step, pixels of its level
    pixels_per_number: float = 5.0
    """Pixels per independent number; only the odds of outliers depend on it."""
    min_correlation: float = 0.03
    max_correlation: float = 0.9
    """Limits of the mean correlation of a right block."""
    correlated: float = 2.0
    correlated_px: float = 60.0
    """Errors of levels and dates correlate: least inflation of the variance over the scatter of
    blocks, and what errors reach over, pixels of the map."""
    min_blocks: int = 8
    singular: float = 1e-15  # least eigenvalue over the largest of what blocks show of the camera
    min_left: float = 0.25
    """Least share of the blocks' numbers that the solution leaves to their scatter."""
    component_prior: float = 4.0
    """Numbers that the prior variance of a systematic error counts as,"""
    max_component: float = 16.0  # and the largest factor on it


SOLVER = Solver()


class Expected(NamedTuple):
    """What telemetry expects: correction (6,), and its information (6, 6)."""

    correction: Array
    information: Array


NOTHING = Expected(np.zeros(6), np.diag(WEAK**-2))


@dataclass(frozen=True, eq=False)
class Resection:
    """Corrections (6,), m east, north, up, deg heading, pitch, roll, and covariances (6, 6);
    `image_only`: by the picture without telemetry, as far as it shows them (`WEAK`)."""

    correction: Array
    covariance: Array
    image_only: Array
    image_only_covariance: Array


def _with_slope(expected: Expected, slope_rad: float) -> Expected:
    """What telemetry expects where pitch and roll may be a slope of the ground instead."""
    correction, information = expected
    loose = information.copy()
    for axis in (4, 5):
        loose[axis, axis] = 1 / (1 / information[axis, axis] + np.degrees(slope_rad) ** 2)
    return Expected(correction, loose)


def _component(values: Array, variances: Array, least: float) -> float:
    """Common variance of systematic errors, 1 as assumed, by expectation maximization."""
    shown = float(values @ values + variances.sum())
    found = (SOLVER.component_prior + shown) / (SOLVER.component_prior + len(values))
    return min(max(found, least), SOLVER.max_component)


class _Marginal(NamedTuple):
    """What blocks say of the camera with systematic errors marginalized: information (6, 6), and
    the part `assumed` (6, 6) of it that these errors' variances decide, not noise."""

    information: Array
    assumed: Array

    @classmethod
    def of(cls, curvature: Array, information: Array) -> "_Marginal":
        """From those of all (D, D): of the blocks, and of what was known before."""
        rest = slice(6, None)
        own = information[rest, rest]
        gain = np.linalg.solve(curvature[rest, rest] + own, curvature[rest, CAMERA])
        left = curvature[CAMERA, CAMERA] - curvature[CAMERA, rest] @ gain
        return cls((left + left.T) / 2, gain.T @ own @ gain)

    def covariance(self, telemetry: Array, variance: float) -> Array:
        """With so many times the variance of all that is noise of blocks."""
        covariance = np.linalg.inv(self.information + telemetry)
        known = covariance @ (telemetry + self.assumed) @ covariance
        return np.asarray(variance * covariance + (1 - variance) * known)

    def without(self, found: Array, expected: Expected) -> Array:
        """The camera (6,) without telemetry: where the quadratic of the blocks has its peak."""
        weak = np.linalg.inv(self.information + NOTHING.information)
        pull = expected.information @ (found - expected.correction)
        return np.asarray(found + weak @ pull)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Of all levels: correlations (L * N, S, S), pixels (L * N,), and the size of these in pixels
    of level 0 (L * N,). `moved_px` (N, 2, D): by each unknown. `correlated`: least inflation of
    their variance."""

    levels: int
    correlated: float
    correlations: Array
    pixels: Array
    unit_px: Array
    moved_px: Array

    @classmethod
    def of(
        cls, levels: Sequence[tuple[BlockScores, float]], moved_px: Array, block_px: float
    ) -> "Blocks | None":
        """None where too few are seen.

        `levels`: of each level the blocks and its pixel in pixels of level 0. `moved_px` (N, 2, 6):
        how far each moves by the camera, pixels right and down at level 0. `block_px`: their width,
        pixels of level 0."""
        correlated = max(SOLVER.correlated, 1 + (SOLVER.correlated_px / block_px) ** 2)
        known = np.tile(np.isfinite(moved_px).all(axis=(1, 2)), len(levels))
        pixels = np.where(known, np.concatenate([scores.pixels for scores, _ in levels]), 0.0)
        by_level = np.asarray(pixels.reshape(len(levels), -1) > 0, np.bool_)
        if by_level.sum(axis=1).max() < SOLVER.min_blocks:
            return None
        correlations = np.concatenate([scores.correlations for scores, _ in levels])
        moved_px = np.where(by_level.any(axis=0).reshape(-1, 1, 1), moved_px, 0.0)
        unit_px = np.repeat([unit for _, unit in levels], len(moved_px))
        return cls(len(levels), correlated, correlations, pixels, unit_px, moved_px)

    def climb(self, expected: Expected, slope_rad: float) -> Array:
        """The correction (6,) alone, from far away."""
        loose = _with_slope(expected, slope_rad)
        correction = self._climbed(np.zeros(6), SOLVER.blurs_px, loose)
        sampled = self.best(self.sampled(loose), loose)
        ascents = [correction, self._climbed(sampled, SOLVER.sharp_px, loose)]
        return self.best(np.stack(ascents), loose)

    def resect(
        self, expected: Expected, systematic: Systematic, variance: float
    ) -> Resection | None:
        """The camera with its covariance, from one known to a pixel or two; None where these are
        not finite. `variance`: of the blocks' noise over what their curvature says."""
        loose = _with_slope(expected, systematic.slope_rad)
        correction = self._climbed(np.zeros(6), SOLVER.sharp_px, loose)
        return self._with(systematic.moves_px)._joint(correction, expected, systematic, variance)

    def _joint(
        self, correction: Array, expected: Expected, systematic: Systematic, variance: float
    ) -> Resection | None:
        """With systematic errors, from a camera (6,) near by."""
        size = self.moved_px.shape[2]
        state, prior, precision = np.zeros(size), np.zeros(size), np.ones(size)
        state[CAMERA], prior[CAMERA] = correction, expected.correction
        inflation = self.correlated
        for _ in range(SOLVER.joint_steps):
            information = np.diag(precision)
            information[CAMERA, CAMERA] = expected.information
            curvature, slopes = self.system(state)
            covariance = np.asarray(np.linalg.inv(curvature / inflation + information))
            pull = slopes.sum(axis=0) / inflation + information @ (prior - state)
            state = state + self.limited(covariance @ pull)
            inflation = self.variance_inflation(curvature, slopes, covariance, inflation)
            for at, least in systematic.components:
                own = slice(6 + at.start, 6 + at.stop)
                precision[own] = 1 / _component(state[own], np.diag(covariance)[own], least)
        shown = _Marginal.of(curvature / inflation, information)
        covariance = shown.covariance(expected.information, variance)
        image_only = shown.without(state[CAMERA], expected)
        weak = shown.covariance(NOTHING.information, variance)
        if not all(np.isfinite(each).all() for each in (state, covariance, image_only, weak)):
            return None
        return Resection(state[CAMERA], covariance, image_only, weak)

    def _with(self, moves_px: Array) -> "Blocks":
        """With more unknowns."""
        used = np.asarray(self.moved_px.any(axis=(1, 2)), np.bool_)
        more_px = np.where(used[:, None, None], moves_px, 0.0)
        return replace(self, moved_px=np.concatenate([self.moved_px, more_px], axis=2))

    def sampled(self, expected: Expected) -> Array:
        """Corrections (S, 6) by the peaks of a few blocks each, chosen by how high these are."""
        mean, information = expected
        count, side = len(self.pixels), self.correlations.shape[1]
        flat = self.correlations.reshape(count, -1)
        highest = flat.argmax(axis=1)
        peaks_px = np.stack([highest % side, highest // side], axis=-1) - side // 2
        height = np.maximum(flat.max(axis=1), 0.0)
        with np.errstate(divide="ignore"):
            chance = np.log(self._weights(self._usual(height)) * height)
        drawn = _drawn(count) - chance
        samples, sample = SOLVER.samples, SOLVER.sample
        chosen = np.argpartition(drawn, sample, axis=1)[:, :sample]
        moved = self._by_level.reshape(count, 2, -1)[chosen].reshape(samples, 2 * sample, 6)
        peaks = peaks_px[chosen].reshape(samples, 2 * sample)
        known = moved.swapaxes(1, 2) / SOLVER.sample_std_px**2
        right = np.einsum("spk,sk->sp", known, peaks) + information @ mean
        return np.asarray(np.linalg.solve(known @ moved + information, right[..., None])[..., 0])

    @cached_property
    def _by_level(self) -> Array:
        """Moves (L * N * 2, D) in pixels of the level."""
        moved = np.tile(self.moved_px, (self.levels, 1, 1)) / self.unit_px[:, None, None]
        return np.asarray(moved.reshape(-1, moved.shape[2]))

    @property
    def used(self) -> int:
        return int((self.pixels.reshape(self.levels, -1) > 0).any(axis=0).sum())

    def _climbed(self, start: Array, blurs_px: Sequence[float], expected: Expected) -> Array:
        """A maximum of the posterior near a correction."""
        correction = start
        for blur_px in blurs_px:
            correction = self.stepped(correction, blur_px, expected)
        return correction

    def best(self, corrections: Array, expected: Expected) -> Array:
        """The most likely one of corrections (S, 6)."""
        mean, information = expected
        moved = corrections @ self._by_level.T
        here = values(self.correlations, moved.reshape(len(corrections), -1, 2))
        usual = self._usual(here).max(axis=0)
        odds = self._weights(usual) * (here - usual / 2)
        # Of 1 + exp(odds): the product of the rest is at most 2 to the power of the blocks.
        fit = np.maximum(odds, 0.0).sum(axis=1) + np.log((1 + np.exp(-np.abs(odds))).prod(axis=1))
        fit /= self.correlated
        off = corrections - mean
        penalty = np.einsum("sp,pq,sq->s", off, information, off) / 2
        return np.asarray(corrections[int(np.argmax(fit - penalty))])

    def _usual(self, correlations: Array) -> Array:
        """Mean correlation (.., L * N) of the level."""
        by_level = (*correlations.shape[:-1], self.levels, -1)
        weighted = (correlations * self.pixels).reshape(by_level).sum(axis=-1)
        pixels = self.pixels.reshape(self.levels, -1).sum(axis=1)
        usual = weighted / np.maximum(pixels, 1.0)
        usual = np.minimum(np.maximum(usual, SOLVER.min_correlation), SOLVER.max_correlation)
        return np.repeat(usual, len(self.pixels) // self.levels, axis=-1)

    def _weights(self, usual: Array) -> Array:
        """Log likelihood ratio (L * N,) per unit of correlation, of a right block against none."""
        return usual / (1 - usual**2) * self.pixels / SOLVER.pixels_per_number

    def stepped(self, state: Array, blur_px: float, expected: Expected) -> Array:
        """One step of Newton's method on a state (D,)."""
        mean, information = expected
        curvature, slopes = self.system(state, blur_px)
        pull = slopes.sum(axis=0) + information @ (mean - state)
        return np.asarray(state + self.limited(np.linalg.solve(curvature + information, pull)))

    def limited(self, step: Array) -> Array:
        """No block by more than `SOLVER.longest_step_px`."""
        longest = float(np.hypot(*(self.moved_px @ step).T).max() / self.unit_px.min())
        return step * min(1.0, SOLVER.longest_step_px / max(longest, 1e-9))

    def variance_inflation(
        self, curvature: Array, slopes: Array, covariance: Array, before: float
    ) -> float:
        """Variance of the slopes by the camera over the curvature, times `correlated`, at least 1;
        the numbers that a solution with `covariance` and inflation `before` uses do not count."""
        numbers = 2 * self.used
        left = max(1 - float((covariance * curvature).sum()) / before / numbers, SOLVER.min_left)
        values, vectors = np.linalg.eigh(curvature[CAMERA, CAMERA])
        spread = np.square(slopes[:, CAMERA] @ vectors).sum(axis=0)
        shown = values > SOLVER.singular * values[-1]
        return max(1.0, self.correlated * float((spread[shown] / values[shown]).sum()) / 6 / left)

    def system(self, state: Array, blur_px: float = 0.0) -> tuple[Array, Array]:
        """Curvature (D, D) of the log likelihood, and its slope (N, D) by each block."""
        slope, curvature = self._pulls((self._by_level @ state).reshape(-1, 2), blur_px)
        size = self.moved_px.shape[2]
        held = (curvature @ self.moved_px).reshape(-1, size)
        x, y = self.moved_px[:, 0], self.moved_px[:, 1]
        return self.moved_px.reshape(-1, size).T @ held, slope[:, :1] * x + slope[:, 1:] * y

    def _pulls(self, moved_px: Array, blur_px: float) -> tuple[Array, Array]:
        """Slopes (N, 2) and curvatures (N, 2, 2) of the log likelihood by places at level 0, of
        blocks moved by so many pixels of the levels (L * N, 2)."""
        count, blur = len(self.moved_px), _gaussian(self.correlations.shape[1], blur_px)
        if KERNEL is not None:
            out = np.empty((count, 6))
            limits = SOLVER.min_correlation, SOLVER.max_correlation
            weighted = self.pixels, self.unit_px, (*limits, SOLVER.pixels_per_number)
            KERNEL.bend(self.correlations, blur, np.ascontiguousarray(moved_px), *weighted, out)
            return out[:, :2], out[:, 2:].reshape(-1, 2, 2)
        blurred = self.correlations if blur is None else blur @ self.correlations @ blur.T
        here, slope, curvature = _quadratic(blurred, moved_px)
        usual = self._usual(here)
        weight = self._weights(usual)
        odds = np.clip(weight * (here - usual / 2), -30.0, 30.0)
        weight = weight / (1 + np.exp(-odds)) / self.unit_px
        slope = (slope * weight[:, None]).reshape(self.levels, count, 2).sum(axis=0)
        curvature = curvature * (weight / self.unit_px)[:, None, None]
        return slope, curvature.reshape(self.levels, count, 2, 2).sum(axis=0)


@lru_cache(maxsize=8)
def _drawn(count: int) -> Array:
    """Random numbers (S, count) whose least ones choose with the chances that are subtracted
    as logarithms. Shared: not to be written to."""
    made = -np.random.default_rng(0).gumbel(size=(SOLVER.samples, count))
    made.flags.writeable = False
    return made


@lru_cache(maxsize=32)
def _gaussian(side: int, blur_px: float) -> Array | None:
    """Blur (side, side) along one axis, None: none. Shared: not to be written to."""
    if blur_px == 0:
        return None
    at = np.arange(side)
    kernel = np.exp(-((at[:, None] - at) ** 2) / (2 * blur_px**2))
    kernel /= kernel.sum(axis=1, keepdims=True)
    kernel.flags.writeable = False
    return kernel


def _quadratic(surfaces: Array, moved_px: Array) -> tuple[Array, Array, Array]:
    """Values (N,), slopes (N, 2), curvatures (N, 2, 2) >= 0 of surfaces (N, S, S) at (N, 2) x, y.

    By the quadratic through the pixels around; 0 beyond the surface."""
    reach = surfaces.shape[1] // 2
    inside = (np.abs(moved_px) <= reach).all(axis=1)
    held = np.clip(moved_px, 1 - reach, reach - 1)
    nearest = np.rint(held)
    x, y = (nearest.astype(int) + reach).T
    around = np.arange(-1, 2)
    rows = np.arange(len(surfaces))[:, None, None]
    patches = surfaces[rows, (y[:, None] + around)[:, :, None], (x[:, None] + around)[:, None]]
    (a, above, b), (left, here, right), (c, below, d) = np.moveaxis(patches, 0, -1)
    slope = np.stack([right - left, below - above], axis=-1) / 2
    along, down = 2 * here - right - left, 2 * here - below - above
    across = (b + c - a - d) / 4
    curvature = np.stack([along, across, across, down], axis=-1).reshape(-1, 2, 2)
    off = np.clip(moved_px - nearest, -1.0, 1.0)
    bent = (curvature @ off[..., None])[..., 0]
    value = here + ((slope - bent / 2) * off).sum(axis=1)
    slope = slope - bent
    return value * inside, slope * inside[:, None], _positive(curvature) * inside[:, None, None]


def values(surfaces: Array, moved_px: Array) -> Array:
    """Of surfaces (N, S, S) at the pixel nearest to displacements (.., N, 2), else 0."""
    reach = surfaces.shape[-1] // 2
    nearest = np.rint(np.minimum(np.maximum(moved_px, -reach), reach)).astype(int) + reach
    count, side = surfaces.shape[:2]
    values = surfaces.take((np.arange(count) * side + nearest[..., 1]) * side + nearest[..., 0])
    beyond = np.abs(moved_px) > reach
    values[beyond[..., 0] | beyond[..., 1]] = 0.0
    return np.asarray(values)


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
