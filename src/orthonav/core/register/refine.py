"""Moving a candidate to its best position, heading and scale, and judging it there.

Gauss-Newton on squared differences of channels, each kind with its own gain, so that correlation is
maximized; derivatives are the view's (inverse compositional, Baker and Matthews, IJCV 2004). The
covariance is the sandwich of robust statistics (Huber 1967; clustered as in Liang and Zeger 1986)
over blocks of the view, for residuals of neighbouring pixels are not independent.

`sharpness` says how much a place stands out from the ground around it, which tells it from texture
that repeats: rows, lattices and single roads fit nearly as well a little aside, and so do places by
chance. Scores aside are compared with that of the place, for all channels, gradients alone, and
phase correlation (Kuglin and Hines, 1975), all from the same spectra (docs/decisions/evidence.md).

`block_scores` says how well each block of a view fits the map when it is moved a little aside.
Under wrong tilt, relief or lens blocks fit at different displacements, which show the camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.template import (
    BLOCKS,
    CHANNELS,
    GROUPS,
    Template,
    block_starts,
    by_steps,
    from_middle,
    gradients,
)
from orthonav.core.register.window import (
    FULLY_VALID,
    MapWindow,
    Pose,
    Reference,
    Sums,
    compared,
    even_scale,
    sampled_planes,
)

Array = NDArray[np.float32]
BLOCK_SUMS = 7


@dataclass(frozen=True)
class Descent:
    """How a refinement goes; values without a source are by NAIP, Szada and recorded flights."""

    steps: int = 6  # at most
    small_step_px: float = 0.03  # ends the refinement
    max_step_px: float = 3.0  # the basin of convergence (docs/decisions/registration.md)
    slack_px: int = 6  # two of these steps
    damping: float = 1e-3  # relative (Levenberg and Marquardt)
    min_correlation: float = 0.08  # in the gain, so that steps do not vanish
    whole_overlap: float = 0.97  # above, the Gauss-Newton matrix of the whole view is used
    min_curvature: float = 0.05
    """Of a direction in the covariance, as a fraction of the Gauss-Newton matrix."""


DESCENT = Descent()


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a view fits the map at a pose and a level.

    `score`: weighted sum of correlations times the root of the pixels; `correlations` of the kinds;
    `overlap`: share on valid map; where asked for, `agreement`: share of blocks that speak for it,
    `blocks_t`: their mean over its standard deviation, `covariance` (4, 4) of x, y, turn, log
    scale."""

    pose: Pose
    level: int
    score: float
    correlations: tuple[float, ...]
    weighted: float
    overlap: float
    converged: bool
    agreement: float = math.nan
    blocks_t: float = math.nan
    covariance: NDArray[np.float64] | None = None


class Refiner:
    def __init__(self, template: Template, reference: Reference) -> None:
        self.template, self.reference = template, reference
        self._reach_px = math.hypot(*template.mask.shape) / 2

    def prepare(self) -> None:
        """What threads share, once."""
        if KERNEL is None:
            _ = self.template.self_slopes, self.template.hessians
        else:
            _ = self.template.numbers

    def place(
        self,
        pose: Pose,
        steps: int = DESCENT.steps,
        small_step_px: float = DESCENT.small_step_px,
        *,
        with_covariance: bool = False,
    ) -> Fit:
        """The best pose within a few pixels of the level; ends below `small_step_px`."""
        window = MapWindow.of(self.template, self.reference, pose, DESCENT.slack_px)
        fit, step = self._refined(window, pose, steps, small_step_px)
        if not with_covariance:
            return fit
        sums = self._spread(window, fit.pose)
        to_map = self._to_map(fit.pose)
        covariance = np.asarray(to_map @ sums.covariance() @ to_map.T)
        if not fit.converged:
            # Still moving: its last step is an error of its own.
            covariance += np.outer(move := to_map @ step, move)
        return replace(
            fit, covariance=covariance, agreement=sums.agreement(), blocks_t=sums.blocks_t()
        )

    def _refined(
        self, window: MapWindow, pose: Pose, steps: int, small_step_px: float
    ) -> tuple[Fit, Sequence[float]]:
        """And the last step (4,)."""
        if KERNEL is None:
            return self._refined_by_numpy(window, pose, steps, small_step_px)
        found, score, correlations, weighted, overlap, converged, step = KERNEL.refine(
            *self._for_kernel(window, pose, steps, small_step_px)
        )
        numbers = score, correlations, weighted, overlap, bool(converged)
        return Fit(Pose(*found), self.template.level, *numbers), step

    def _for_kernel(
        self, window: MapWindow, pose: Pose, steps: int, small_step_px: float
    ) -> tuple[object, ...]:
        template = self.template
        limits = (
            *(window.row, window.col, window.unit, steps, small_step_px),
            *(DESCENT.max_step_px, DESCENT.damping, DESCENT.min_correlation, DESCENT.whole_overlap),
        )
        at = (pose.x_px, pose.y_px, pose.heading_rad, pose.log_scale)
        return window.made, template.values, template.slopes, template.numbers, at, limits

    def _refined_by_numpy(
        self, window: MapWindow, pose: Pose, steps: int, small_step_px: float
    ) -> tuple[Fit, Sequence[float]]:
        unit = 2.0**self.template.level
        converged, step = False, [0.0] * 4
        comparison = best = self._compared(window, pose)
        for _ in range(steps):
            step = self._step(comparison)
            moves_px = self._moves_px(step)
            share = min(1.0, DESCENT.max_step_px / max(moves_px, 1e-9))
            step = [share * each for each in step]
            moved = comparison.pose.stepped([unit * step[0], unit * step[1], *step[2:]])
            comparison = self._compared(window, moved)
            if comparison.score > best.score:
                best = comparison
            converged = moves_px < small_step_px
            if converged:
                break
        return best.fit(converged), step

    def _compared(self, window: MapWindow, pose: Pose) -> "Comparison":
        planes = sampled_planes(window, pose)
        return Comparison(self.template, pose, compared(self.template, *planes))

    def _hessian(self, comparison: "Comparison") -> NDArray[np.float64]:
        """Over the part of the view that lies on the map."""
        first, second = comparison.squares
        hessians = self.template.hessians
        if comparison.overlap <= DESCENT.whole_overlap:
            # Block by block: derivatives weigh alike within one.
            hessians = np.tensordot(comparison.shares(), self.template.block_hessians, axes=1)
        return np.asarray(first * hessians[0] + second * hessians[1])

    def _spread(self, window: MapWindow, pose: Pose) -> "SpreadSums":
        if KERNEL is None:
            pixels = _Pixels(self.template, window, pose)
            hessian = self._hessian(pixels.comparison)
            return SpreadSums(pixels.observed(), hessian, pixels.sums_by_block())
        out = np.empty(2 * 16 + BLOCKS**2 * BLOCK_SUMS)
        KERNEL.spread(*self._for_kernel(window, pose, 0, 0.0), out)
        observed, hessian = out[:32].reshape(2, 4, 4)
        return SpreadSums(observed, hessian, out[32:].reshape(-1, BLOCK_SUMS))

    def _step(self, comparison: "Comparison") -> list[float]:
        """Of the window: x, y (px of the level), turn, log scale."""
        hessian = self._hessian(comparison)
        hessian.flat[::5] *= 1 + DESCENT.damping
        hessian.flat[::5] += 1e-12
        found: list[float] = np.linalg.solve(hessian, comparison.slope()).tolist()
        return found

    def _moves_px(self, step: Sequence[float]) -> float:
        return math.hypot(step[0], step[1]) + self._reach_px * math.hypot(step[2], step[3])

    def _to_map(self, pose: Pose) -> NDArray[np.float64]:
        """From steps of the window to position (level-0 px), turn and log scale."""
        to_map = np.eye(4)
        to_map[:2, :2] = pose.linear * 2.0**self.template.level
        return to_map


class SpreadSums(NamedTuple):
    """What a covariance is made of.

    - `observed` (4, 4): products of the view's derivatives by the steps and the map's.
    - `blocks` (B * B, 7): derivatives (4) of the score, products of both kinds of channels, pixels.
    """

    observed: NDArray[np.float64]
    hessian: NDArray[np.float64]
    blocks: NDArray[np.float64]

    def covariance(self) -> NDArray[np.float64]:
        """The curvature is that of the view's derivatives times the map's: noise and change have
        derivatives too, and would make a position appear known along ground of one direction."""
        terms = self.blocks[:, :4]
        spread = terms.T @ terms * (BLOCKS**2 / (BLOCKS**2 - 4))
        inverse = _bounded_inverse((self.observed + self.observed.T) / 2, self.hessian)
        return np.asarray(inverse @ spread @ inverse.T)

    def agreement(self) -> float:
        """Fraction of blocks whose channels correlate positively."""
        sums, counts = self.blocks[:, 4] + self.blocks[:, 5], self.blocks[:, 6]
        used = counts > 0.25 * counts.max()
        return float((sums[used] > 0).mean()) if used.any() else 0.0

    def blocks_t(self) -> float:
        """Sum of the gradients' products over blocks, by the root of their squares."""
        sums = self.blocks[:, 4]
        return float(sums.sum() / max(math.sqrt(float(sums @ sums)), 1e-12))


def _bounded_inverse(
    observed: NDArray[np.float64], hessian: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of `observed`, no direction held less than a fraction of what `hessian` says."""
    own = np.sqrt(np.diag(hessian)) + 1e-12
    values, vectors = np.linalg.eigh(observed / np.outer(own, own))
    inverse = (vectors / np.maximum(values, DESCENT.min_curvature)) @ vectors.T
    return np.asarray(inverse / np.outer(own, own))


class Comparison:
    """A view beside the map. Steps are gain * map - correlation^2 * view, by kind: plain
    differences would fall short by the square of the correlation."""

    def __init__(self, template: Template, pose: Pose, sums: Sums) -> None:
        self.template, self.pose, self._sums = template, pose, sums
        pixels = template.pixels - float(self._sums.left_pixels.sum())
        self.overlap = pixels / max(template.pixels, 1.0)
        # Rounding of a difference must not make it negative.
        own = np.maximum(template.energies - self._sums.left_energies, 0.0).tolist()
        found, squares, gains = [], [], []
        for product, energy, mine in zip(
            self._sums.products.tolist(), self._sums.energies.tolist(), own, strict=True
        ):
            correlation = product / math.sqrt(energy * mine) if energy * mine > 0 else 0.0
            square = max(correlation, DESCENT.min_correlation) ** 2
            found.append(correlation)
            squares.append(square)
            gains.append(math.sqrt(square * mine / energy) if energy > 0 else 0.0)
        self.correlations, self.squares, self.gains = tuple(found), tuple(squares), tuple(gains)
        total = sum(w * c for w, c in zip(template.weights, found, strict=True))
        self.weighted = total / sum(template.weights)
        self.score = total * math.sqrt(max(pixels, 0.0)) * even_scale(pose.log_scale)

    def slope(self) -> NDArray[np.float64]:
        own = self.template.self_slopes - self._sums.left_slopes
        return np.asarray(self.gains @ self._sums.slopes - self.squares @ own)

    def shares(self) -> NDArray[np.float64]:
        pixels = self.template.block_pixels
        return np.asarray((pixels - self._sums.left_pixels) / np.maximum(pixels, 1.0))

    def fit(self, converged: bool) -> Fit:
        return Fit(
            self.pose,
            self.template.level,
            self.score,
            self.correlations,
            self.weighted,
            self.overlap,
            converged=converged,
        )


class _Pixels:
    """`map` (3, H, W), `counts` (H, W), `residual`: gain * map - correlation^2 * view."""

    def __init__(self, template: Template, window: MapWindow, pose: Pose) -> None:
        planes, valid = sampled_planes(window, pose)
        sums = compared(template, planes, valid, slopes=False)
        self.template, self.comparison = template, Comparison(template, pose, sums)
        self.counts = template.mask * (valid > FULLY_VALID)
        self.map = planes * self.counts
        self._view = template.channels * self.counts
        gains = np.repeat(self.comparison.gains, [2, 1])
        squares = np.repeat(self.comparison.squares, [2, 1])
        self.residual = np.empty_like(self.map)
        for at in range(len(self.map)):
            cv2.addWeighted(
                self.map[at], gains[at], self._view[at], -squares[at], 0, dst=self.residual[at]
            )

    def observed(self) -> NDArray[np.float64]:
        mine = self.template.gradients
        theirs = gradients(self.map, self.counts)
        theirs *= np.repeat(self.comparison.gains, [2, 1]).astype(np.float32)[:, None, None, None]
        x, y = from_middle(*self.template.mask.shape)
        rows, cols = (np.stack([np.ones(each.size, np.float32), each.ravel()]) for each in (y, x))
        sums = np.empty((2, 4, 2, 2))  # of the view along x and y, of the map by the steps
        for at in range(2):
            products = mine[0, at] * theirs[0]
            for one, other in zip(mine[1:, at], theirs[1:], strict=True):
                products += one * other
            sums[at] = rows @ by_steps(products) @ cols.T  # once, and times x and y
        across, down = sums
        return np.stack(
            [
                across[:, 0, 0],
                down[:, 0, 0],
                down[:, 0, 1] - across[:, 1, 0],
                across[:, 0, 1] + down[:, 1, 0],
            ]
        )

    def sums_by_block(self) -> NDArray[np.float64]:
        terms = by_steps(np.einsum("cphw,chw->phw", self.template.gradients, self.residual))
        products = self._view * self.map
        kinds = [products[group].sum(axis=0) for group in GROUPS]
        each = np.stack([*terms, *kinds, self.counts])
        return self.template.block_sums(each).astype(np.float64).T


PHASE_FLOOR = 1e-3  # fraction of the mean power below which frequencies count less


class Sharpness(NamedTuple):
    """Over scores a little aside: `local_ratio` of all channels over the best, up to 10; 0 without
    correlation; `local_gradients`, `local_phase` over the mean, in standard deviations."""

    local_ratio: float
    local_gradients: float
    local_phase: float


def sharpness(template: Template, reference: Reference, pose: Pose) -> Sharpness:
    """At the heading and scale of `pose`."""
    moved = _moved_scores(template, reference, pose)
    rows, cols = (np.arange(side, dtype=np.float64) - side // 2 for side in moved.shape[1:])
    moved_px = np.hypot(rows[:, None], cols)
    # The place itself is the best near by; smaller moves than those aside belong to it too.
    near, aside = moved_px <= 3.0, moved_px > max(3.0, 0.06 * math.sqrt(template.pixels))
    return Sharpness(
        _ratio(moved[0] + moved[1], near, aside),
        _deviations(moved[0], near, aside),
        _deviations(moved[2], near, aside),
    )


def _ratio(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    here, rival = float(scores[near].max()), float(scores[aside].max(initial=0.0))
    return min(here / max(rival, 1e-6), 10.0) if here > 0 else 0.0


def _deviations(scores: Array, near: NDArray[np.bool_], aside: NDArray[np.bool_]) -> float:
    others = scores[aside]
    if not others.size:
        return 0.0
    return float((scores[near].max() - others.mean()) / (others.std() + 1e-9))


def _moved_scores(template: Template, reference: Reference, pose: Pose) -> Array:
    """Scores (3, 2 R + 1, 2 C + 1) of gradients, grey and phase correlation, by rows and columns.

    Not divided by the energy of the map under each move: that hardly changes."""
    height, width = template.mask.shape
    rows, cols = (max(8, int(side / 8)) for side in (height, width))
    window = MapWindow.of(template, reference, pose, 0, (rows, cols))
    # Moves of less than the margin never reach over the border: no padding.
    size = tuple(cv2.getOptimalDFTSize(side) for side in window.shape)
    if KERNEL is not None:
        moved = np.empty((3, 2 * rows + 1, 2 * cols + 1), np.float32)
        KERNEL.moved(
            *(
                window.made,
                template.values,
                template.weights,
                window.matrix(pose),
                pose.heading_rad,
            ),
            *((rows, cols), size, PHASE_FLOOR, moved),
        )
        return moved
    planes, _ = sampled_planes(window, pose)
    for group, weight in zip(GROUPS, template.weights, strict=True):
        energy = float(np.square(planes[group]).sum())
        planes[group] *= math.sqrt(weight / energy) if energy > 0 else 0.0
    products = np.conj(np.fft.rfft2(template.channels, s=size, axes=(1, 2)))
    products *= np.fft.rfft2(planes, s=size, axes=(1, 2))
    power = np.abs(products)
    floor = PHASE_FLOOR * power.mean(axis=(1, 2), keepdims=True) + 1e-12
    phase = (products / (power + floor)).sum(axis=0)
    parts = np.stack([*(products[group].sum(axis=0) for group in GROUPS), phase])
    surface = np.fft.irfft2(parts, s=size, axes=(1, 2))
    return np.asarray(surface[:, : 2 * rows + 1, : 2 * cols + 1], np.float32)


BLOCK_GREY_SHARE = 0.25
"""Grey over gradients: less than in the search, seasons mislead (docs/decisions/camera.md)."""
MIN_SEEN = 0.4  # blocks of which less is seen on valid map do not count
MIN_ENERGY = 0.1
"""Nor those below this fraction of the median energy: edges brought in would count too much."""


class BlockScores(NamedTuple):
    """Correlation of each block of a view with the map under small displacements.

    - `correlations` (B * B, 2 R + 1, 2 R + 1): by pixels down and right on the map.
    - `pixels` (B * B,): that count, 0 where too few of a block are seen.
    - `middles_px` (B * B, 2): x and y from the middle of the window."""

    correlations: NDArray[np.float64]
    pixels: NDArray[np.float64]
    middles_px: NDArray[np.float64]


def block_scores(
    template: Template, reference: Reference, pose: Pose, reach_px: int
) -> BlockScores:
    """Of a view whose window lies at `pose`, moved by up to `reach_px` pixels of the level."""
    rows, cols = template.mask.shape
    window = MapWindow.of(template, reference, pose, 1, (reach_px, reach_px))
    if KERNEL is None:
        found, pixels = _correlated(
            *_products_of_blocks(template, window, pose, reach_px), rows * cols
        )
    else:
        count, side = BLOCKS * BLOCKS, 2 * reach_px + 1
        found, pixels = np.empty((count, side, side)), np.empty(count)
        at = window.matrix(pose), pose.heading_rad
        shares = BLOCK_GREY_SHARE * (template.weights[1] > 0), MIN_SEEN, MIN_ENERGY
        KERNEL.blocks(window.made, template.planes, *at, reach_px, shares, found, pixels)
    return BlockScores(found, pixels, _middles_px(rows, cols))


def _correlated(
    products: Array, sums: NDArray[np.float64], view_px: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Correlations (B * B, 2 R + 1, 2 R + 1) and pixels (B * B,) that count."""
    used = sums[2] >= MIN_SEEN * view_px / len(products)
    for each in sums[:2]:
        used &= each > MIN_ENERGY * np.median(each)
    scale = np.where(used, 1 / np.sqrt(np.where(used, sums[0] * sums[1], 1.0)), 0.0)
    return (products * scale[:, None, None]).clip(-1.0, 1.0), np.where(used, sums[2], 0.0)


@lru_cache(maxsize=64)
def _middles_px(rows: int, cols: int) -> NDArray[np.float64]:
    """Of the blocks (B * B, 2), shared: not to be written to."""
    y, x = (
        (np.append(each[1:], size) + each) / 2 - size / 2
        for each, size in zip(block_starts((rows, cols)), (rows, cols), strict=True)
    )
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    middles.flags.writeable = False
    return middles


def _products_of_blocks(
    template: Template, window: MapWindow, pose: Pose, reach_px: int
) -> tuple[Array, NDArray[np.float64]]:
    """Products (B * B, 2 R + 1, 2 R + 1) of blocks with the map, moved; of each block the energy in
    the view and on the map, and the pixels that count (3, B * B)."""
    rows, cols = template.mask.shape
    seen = _sampled(window, pose)
    here = seen[reach_px : reach_px + rows, reach_px : reach_px + cols]
    own_weights, own = _energies(template, template.values)
    weights, energies = _energies(template, here)
    used = template.planes * np.sqrt(own_weights * weights)[:, None, None].astype(np.float32)
    side = 2 * reach_px + 1
    products = np.empty((BLOCKS * BLOCKS, side, side), np.float32)
    for down, right in np.ndindex(side, side):
        moved = np.moveaxis(seen[down : down + rows, right : right + cols, :3], 2, 0)
        products[:, down, right] = template.block_sums((used[:3] * moved).sum(axis=0))
    pixels = template.block_sums(template.mask * here[..., 3])
    return products, np.stack([own, energies, pixels])


def _sampled(window: MapWindow, pose: Pose) -> Array:
    """The window (H, W, 4), edge directions turned; 0 where not valid."""
    sampled = window.sample(pose)
    cos, sin = math.cos(2 * pose.heading_rad), math.sin(2 * pose.heading_rad)
    turn = np.eye(CHANNELS, dtype=np.float32)
    turn[:2, :2] = [[cos, sin], [-sin, cos]]
    turned = np.asarray(cv2.transform(sampled, turn), np.float32)
    turned[sampled[..., 3] < 0.99] = 0.0
    return turned


def _energies(template: Template, values: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (4,) of the squares of channels (H, W, 4), and the weighted energy of each block."""
    squares = np.moveaxis(np.square(values, dtype=np.float64), 2, 0)
    blocks = template.block_sums(squares)
    gradients, grey = float(blocks[:2].sum()), float(blocks[2].sum())
    counts = grey > 0 and template.weights[1] > 0  # else the view is compared without grey
    weights = np.array([1.0, 1.0, BLOCK_GREY_SHARE * gradients / grey if counts else 0.0, 0.0])
    return weights, weights @ blocks
