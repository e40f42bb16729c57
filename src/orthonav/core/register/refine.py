"""Moving a candidate to its best position, heading and scale, and judging it there.

Gauss-Newton on squared differences of channels, each kind with its own gain, so that correlation is
maximized; derivatives are the view's (inverse compositional, Baker and Matthews, IJCV 2004). The
covariance is the sandwich of robust statistics (Huber 1967; clustered as in Liang and Zeger 1986)
over blocks of the view, for residuals of neighbouring pixels are not independent."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.register.channels import GROUPS
from orthonav.core.register.kernel import KERNEL
from orthonav.core.register.pose import Pose, even_scale
from orthonav.core.register.template import BLOCKS, Template, by_steps, from_middle, gradients
from orthonav.core.register.window import (
    FULLY_VALID,
    MapWindow,
    Reference,
    Sums,
    compared,
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
        at = (pose.x_px, pose.y_px, pose.turn_rad, pose.log_scale)
        return window.made, template.values, template.slopes, template.numbers, at, limits

    def _refined_by_numpy(
        self, window: MapWindow, pose: Pose, steps: int, small_step_px: float
    ) -> tuple[Fit, Sequence[float]]:
        unit = 2.0**self.template.level
        converged, step = False, [0.0] * 4
        seen = best = self._compared(window, pose)
        for _ in range(steps):
            step = self._step(seen)
            moves_px = self._moves_px(step)
            share = min(1.0, DESCENT.max_step_px / max(moves_px, 1e-9))
            step = [share * each for each in step]
            moved = seen.pose.stepped([unit * step[0], unit * step[1], *step[2:]])
            seen = self._compared(window, moved)
            if seen.score > best.score:
                best = seen
            converged = moves_px < small_step_px
            if converged:
                break
        return best.fit(converged), step

    def _compared(self, window: MapWindow, pose: Pose) -> "Comparison":
        planes = sampled_planes(window, pose)
        return Comparison(self.template, pose, compared(self.template, *planes))

    def _hessian(self, seen: "Comparison") -> NDArray[np.float64]:
        """Over the part of the view that lies on the map."""
        first, second = seen.squares
        hessians = self.template.hessians
        if seen.overlap <= DESCENT.whole_overlap:
            # Block by block: derivatives weigh alike within one.
            hessians = np.tensordot(seen.shares(), self.template.block_hessians, axes=1)
        return np.asarray(first * hessians[0] + second * hessians[1])

    def _spread(self, window: MapWindow, pose: Pose) -> "SpreadSums":
        if KERNEL is None:
            pixels = _Pixels(self.template, window, pose)
            return SpreadSums(pixels.observed(), self._hessian(pixels.seen), pixels.sums_by_block())
        out = np.empty(2 * 16 + BLOCKS**2 * BLOCK_SUMS)
        KERNEL.spread(*self._for_kernel(window, pose, 0, 0.0), out)
        observed, hessian = out[:32].reshape(2, 4, 4)
        return SpreadSums(observed, hessian, out[32:].reshape(-1, BLOCK_SUMS))

    def _step(self, seen: "Comparison") -> list[float]:
        """Of the window: x, y (px of the level), turn, log scale."""
        hessian = self._hessian(seen)
        hessian.flat[::5] *= 1 + DESCENT.damping
        hessian.flat[::5] += 1e-12
        found: list[float] = np.linalg.solve(hessian, seen.slope()).tolist()
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
        seen = Comparison(template, pose, compared(template, planes, valid, slopes=False))
        self.seen = seen
        self.counts = template.mask * (valid > FULLY_VALID)
        self.map = planes * self.counts
        self._view = template.channels * self.counts
        gains, squares = (np.repeat(each, [2, 1]) for each in (seen.gains, seen.squares))
        self.residual = np.empty_like(self.map)
        for at in range(len(self.map)):
            cv2.addWeighted(
                self.map[at], gains[at], self._view[at], -squares[at], 0, dst=self.residual[at]
            )

    def observed(self) -> NDArray[np.float64]:
        mine = self.seen.template.gradients
        theirs = gradients(self.map, self.counts)
        theirs *= np.repeat(self.seen.gains, [2, 1]).astype(np.float32)[:, None, None, None]
        x, y = from_middle(*self.seen.template.mask.shape)
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
        terms = by_steps(np.einsum("cphw,chw->phw", self.seen.template.gradients, self.residual))
        products = self._view * self.map
        kinds = [products[group].sum(axis=0) for group in GROUPS]
        each = np.stack([*terms, *kinds, self.counts])
        return self.seen.template.block_sums(each).astype(np.float64).T
