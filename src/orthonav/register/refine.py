"""Moving a candidate to its best position, heading and scale, and judging it there.

Gauss-Newton on the sum of squared differences between a view's evidence and the map's, each kind
of evidence with its own gain, so that correlation is what is maximized; the step is found on the
view's side, whose derivatives are made once (inverse compositional alignment, Baker and Matthews,
IJCV 2004). The covariance is the sandwich of robust statistics (Huber 1967; clustered as in Liang
and Zeger 1986): residuals of neighbouring pixels are not independent, so their scores are summed
by blocks of the view, and the spread of those sums is what moves the peak.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.register.evidence import GROUPS
from orthonav.register.map_window import MapWindow
from orthonav.register.memory import thread_memory
from orthonav.register.pose import Pose, even_scale
from orthonav.register.reference import Reference
from orthonav.register.template import BLOCKS, Template, derivatives, turn_planes

Array = NDArray[np.float32]
STEPS = 6
"""Gauss-Newton steps at most. Like the other values here without a source of their own, chosen on
the scenes of `python -m benchmarks.real_imagery`."""
SLACK_PX = 6
"""Margin of the map window around the first pose: two steps of `MAX_STEP_PX`."""
SMALL_STEP_PX = 0.03
"""A step that moves no part of the view by more than this ends the refinement."""
MAX_STEP_PX = 3.0
"""Longest step: about the basin of convergence (docs/decisions/registration.md, 6)."""
DAMPING = 1e-3
"""Relative damping of the Gauss-Newton matrix (Levenberg and Marquardt)."""
MIN_CORRELATION = 0.08
"""Correlations below count as this in the gain, so that steps do not vanish."""
WHOLE_OVERLAP = 0.97
"""Above this overlap the Gauss-Newton matrix of the whole view is used."""
MIN_CURVATURE = 0.05
"""Least curvature of a direction in the covariance, as a share of the Gauss-Newton matrix."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A view placed on the map.

    `score`: weighted sum of correlations times the square root of the pixels of the level that
    it rests on; `correlations` of the kinds of evidence, `weighted` their weighted mean;
    `overlap`: share of the view that lies on valid map; `converged` whether it stopped moving;
    `agreement`: share of the blocks of the view that speak for it, `blocks_t`: their mean over its
    standard deviation if they were independent, and `covariance` (4, 4) of position (level-0
    pixels), turn (rad) and log scale, where they were asked for.
    """

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

    @classmethod
    def unjudged(cls, pose: Pose, level: int) -> "Placed":
        """A proposed pose that was not judged yet."""
        return cls(pose, level, math.nan, (), math.nan, math.nan, False)


class Refiner:
    """Refines candidates of one view at one level. Not to be shared between threads."""

    def __init__(self, template: Template, reference: Reference) -> None:
        self.template, self.reference = template, reference
        self._jacobian = [rows.reshape(4, -1) for rows in template.jacobian]
        self._reach_px = math.hypot(*template.mask.shape) / 2
        self._scratch = _Scratch(template)

    def place(
        self,
        pose: Pose,
        steps: int = STEPS,
        small_step_px: float = SMALL_STEP_PX,
        *,
        with_covariance: bool = False,
    ) -> Placed:
        """The view at the best pose near `pose`, within a few pixels of the level.

        It ends where a step moves no part of the view by more than `small_step_px`.
        """
        window = MapWindow.of(self.template, self.reference, pose, SLACK_PX)
        unit = np.array([2.0**self.template.level, 2.0**self.template.level, 1.0, 1.0])
        converged, step = False, np.zeros(4)
        seen = self._scratch.seen(window, pose)
        best = seen.placed()
        for _ in range(steps):
            step = self._step(seen)
            moves_px = self._moves_px(step)
            step *= min(1.0, MAX_STEP_PX / max(moves_px, 1e-9))
            seen = self._scratch.seen(window, seen.pose.stepped(step * unit))
            if seen.score > best.score:
                best = seen.placed()
            if moves_px < small_step_px:
                converged = True
                break
        best = replace(best, converged=converged)
        if not with_covariance:
            return best
        if seen.pose is not best.pose:
            seen = self._scratch.seen(window, best.pose)
        covariance = self._covariance(seen)
        if not converged:
            # Still moving: its last step is an error of its own.
            covariance += np.outer(move := self._to_map(seen) @ step, move)
        return replace(
            best, covariance=covariance, agreement=seen.agreement(), blocks_t=seen.blocks_t()
        )

    def pulls(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What moves each block of the view over the map at `pose`: gradient (B * B, 2) of the
        score's decrease and curvature (B * B, 2, 2), by level-0 pixels of the map."""
        template = self.template
        window = MapWindow.of(template, self.reference, pose, SLACK_PX)
        seen = self._scratch.seen(window, pose)
        terms = np.einsum("cphw,chw->phw", template.jacobian[:, :2], seen.residual)
        slopes = template.block_sums(terms).astype(np.float64).T
        share = template.block_sums(seen.counts) / np.maximum(template.block_pixels, 1.0)
        each = np.tensordot(template.block_hessians, seen.squares, axes=([1], [0]))
        to_window = np.linalg.inv(pose.linear * 2.0**template.level)
        curvature = to_window.T @ (share[:, None, None] * each[:, :2, :2]) @ to_window
        # A step of the window moves what it shows the other way.
        return -slopes @ to_window, curvature

    def _hessian(self, seen: "_Seen") -> NDArray[np.float64]:
        """Gauss-Newton matrix (4, 4) over the part of the view that lies on the map."""
        if seen.overlap > WHOLE_OVERLAP:
            return np.asarray(np.tensordot(seen.squares, self.template.hessians, axes=1))
        # Block by block: derivatives weigh alike within one.
        share = self.template.block_sums(seen.counts) / np.maximum(self.template.block_pixels, 1.0)
        each = np.tensordot(share, self.template.block_hessians, axes=1)
        return np.asarray(np.tensordot(seen.squares, each, axes=1))

    def _observed_inverse(self, seen: "_Seen") -> NDArray[np.float64]:
        """Inverse (4, 4) of the view's derivatives times the map's.

        Noise and change have derivatives too: counted as if they held the view in place, they
        would make the position appear known along ground that runs in one direction.
        """
        theirs = derivatives(seen.map, seen.counts).reshape(3, 4, -1)
        gains = np.repeat(seen.gains, [2, 1])
        observed = np.zeros((4, 4))
        for gain, mine, other in zip(gains, self._jacobian, theirs, strict=True):
            observed += gain * (mine @ other.T)
        return _bounded_inverse((observed + observed.T) / 2, self._hessian(seen))

    def _step(self, seen: "_Seen") -> NDArray[np.float64]:
        """Gauss-Newton step of the window: x, y (px of the level), turn, log scale."""
        slope = sum(
            rows @ part.reshape(-1)
            for rows, part in zip(self._jacobian, seen.residual, strict=True)
        )
        hessian = self._hessian(seen)
        hessian.flat[::5] *= 1 + DAMPING
        hessian.flat[::5] += 1e-12
        return np.asarray(np.linalg.solve(hessian, np.asarray(slope, np.float64)))

    def _moves_px(self, step: NDArray[np.float64]) -> float:
        return float(math.hypot(step[0], step[1]) + self._reach_px * math.hypot(step[2], step[3]))

    def _to_map(self, seen: "_Seen") -> NDArray[np.float64]:
        """From steps of the window to position (level-0 px), turn and log scale: (4, 4)."""
        to_map = np.eye(4)
        to_map[:2, :2] = seen.pose.linear * 2.0**self.template.level
        return to_map

    def _covariance(self, seen: "_Seen") -> NDArray[np.float64]:
        """Covariance (4, 4) of x, y (level-0 px), turn and log scale."""
        terms = np.einsum("cphw,chw->phw", self.template.jacobian, seen.residual)
        sums = self.template.block_sums(terms).astype(np.float64)
        spread = sums @ sums.T * (BLOCKS**2 / (BLOCKS**2 - 4))
        inverse = self._observed_inverse(seen)
        to_map = self._to_map(seen)
        return np.asarray(to_map @ inverse @ spread @ inverse @ to_map.T)


def _bounded_inverse(
    observed: NDArray[np.float64], hessian: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Inverse (P, P) of `observed`, no direction held less than a share of what `hessian` says."""
    own = np.sqrt(np.diag(hessian)) + 1e-12
    values, vectors = np.linalg.eigh(observed / np.outer(own, own))
    inverse = (vectors / np.maximum(values, MIN_CURVATURE)) @ vectors.T
    return np.asarray(inverse / np.outer(own, own))


class _Scratch:
    """Memory for one pose of a view, used again for every other: fresh pages would cost more than
    the arithmetic. What `seen` returned before, from any refiner of the thread, is overwritten."""

    def __init__(self, template: Template) -> None:
        self.template = template
        planes = thread_memory("refine", 16 * template.mask.size).reshape(16, *template.mask.shape)
        self.interleaved = planes[:4].reshape(*template.mask.shape, 4)
        self.planes, self.turned = planes[4:8], planes[8:10]
        self.residual, self.product, self.counts = planes[10:13], planes[13:16], planes[8]

    def seen(self, window: MapWindow, pose: Pose) -> "_Seen":
        """The view beside the map under a pose."""
        window.sample(pose, self.interleaved)
        turn_planes(self.interleaved, -pose.turn_rad, self.planes, self.turned)
        return _Seen(self, pose)


class _Seen:
    """A template beside the map (4, H, W) under one pose.

    `residual` (3, H, W): for each kind of evidence gain * map - correlation^2 * view, so that its
    part of the step is what moves the peak, weighted by what that kind can say: steps from the
    plain difference would fall short by the square of the correlation.
    """

    def __init__(self, scratch: _Scratch, pose: Pose) -> None:
        template = self._template = scratch.template
        self.pose = pose
        view, seen, valid = template.channels, scratch.planes[:3], scratch.planes[3]
        counts = template.mask
        if not (template.whole and valid.min() > 0.99):
            counts = np.multiply(counts, valid > 0.99, out=scratch.counts)
            seen *= counts
        self.counts = counts
        pixels = float(counts.sum())
        self.overlap = pixels / max(template.pixels, 1.0)
        if self.overlap < 0.9999:
            view = np.multiply(view, counts, out=scratch.product)
        self._view, self.map = view, seen
        self.residual = scratch.residual
        found, squares, gains = [], [], []
        for group in GROUPS:
            mine, theirs = view[group].reshape(-1), seen[group].reshape(-1)
            product = float(mine @ theirs)
            energy, own = float(theirs @ theirs), float(mine @ mine)
            correlation = product / math.sqrt(energy * own) if energy * own > 0 else 0.0
            square = max(correlation, MIN_CORRELATION) ** 2
            gain = math.sqrt(square * own / energy) if energy > 0 else 0.0
            for at in range(group.start, group.stop):
                cv2.addWeighted(seen[at], gain, view[at], -square, 0, dst=self.residual[at])
            found.append(correlation)
            gains.append(gain)
            squares.append(square)
        self.correlations = tuple(found)
        self.squares, self.gains = np.array(squares), np.array(gains)
        total = float(np.dot(template.weights, found))
        self.weighted = total / sum(template.weights)
        self.score = total * math.sqrt(pixels) * even_scale(pose.log_scale)

    def placed(self) -> Placed:
        """The numbers of this pose."""
        return Placed(
            self.pose,
            self._template.level,
            self.score,
            self.correlations,
            self.weighted,
            self.overlap,
            converged=False,
        )

    def agreement(self) -> float:
        """Share of the blocks of a view whose evidence correlates positively."""
        sums = self._template.block_sums((self._view * self.map).sum(axis=0))
        counts = self._template.block_sums(self.counts)
        used = counts > 0.25 * counts.max()
        return float((sums[used] > 0).mean()) if used.any() else 0.0

    def blocks_t(self) -> float:
        """Sum of the gradients' products over the blocks of a view, divided by the root of the sum
        of their squares: large where many blocks agree, not a few strong ones."""
        gradients = GROUPS[0]
        products = (self._view[gradients] * self.map[gradients]).sum(axis=0)
        sums = self._template.block_sums(products).astype(np.float64)
        return float(sums.sum() / max(math.sqrt(float(sums @ sums)), 1e-12))
