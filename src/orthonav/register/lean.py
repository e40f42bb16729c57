"""How much more a camera leans than was told, from the perspective of what it sees.

A camera that leans sees near ground larger than far ground. Told too little of it, the rectified
view is bent against the map by a displacement that grows with the square of the distance from the
point below. That bend is found like position, heading and scale are: Gauss-Newton, and a sandwich
covariance (see `refine`). Where the field of view is narrow little is learnt, and the covariance
says so.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.register.pose import Pose
from orthonav.register.reference import Reference
from orthonav.register.refine import DAMPING, Placed, Refiner, bounded_inverse
from orthonav.register.template import BLOCKS, Template, basis_fields, derivatives

Array = NDArray[np.float64]
POSE, LEAN = 4, 2


@dataclass(frozen=True, eq=False)
class LeanStep:
    """What a view says of its pose and lean.

    `step` (6,): from the pose looked at to the best one: x, y (level-0 px), turn (rad), log scale,
    and the lean in the units of the fields. `covariance` (6, 6) of it.
    """

    step: Array
    covariance: Array


class LeanRefiner:
    """Looks at a view that is placed already for how it leans. Not to be shared between threads.

    `fields` (2, 2, H, W) says by how many pixels x and y the ground of each pixel of the template
    lies elsewhere for a unit of each kind of lean.
    """

    def __init__(
        self, template: Template, reference: Reference, fields: NDArray[np.float32]
    ) -> None:
        self._refiner = Refiner(template, reference)
        self._template = template
        bent, self._shares = _beyond_pose(fields, template.mask)
        self._bent = bent.astype(np.float32)
        self._jacobian = self._with_lean(template.jacobian)

    def place(self, pose: Pose, steps: int) -> Placed:
        """The view at the best pose near `pose`, its lean left alone."""
        return self._refiner.place(pose, steps)

    def look(self, pose: Pose) -> LeanStep:
        """The step from `pose` towards the best pose and lean together."""
        seen = self._refiner.seen(pose)
        jacobian, residual = self._jacobian, seen.residual
        slope = np.einsum("cphw,chw->p", jacobian, residual, optimize=True).astype(np.float64)
        gains = np.repeat(seen.squares, [2, 1])
        flat = jacobian.reshape(3, POSE + LEAN, -1)
        hessian = np.zeros((POSE + LEAN, POSE + LEAN))
        for gain, rows in zip(gains, flat, strict=True):
            hessian += gain * (rows @ rows.T)
        damped = hessian.copy()
        damped.flat[:: POSE + LEAN + 1] *= 1 + DAMPING
        damped.flat[:: POSE + LEAN + 1] += 1e-12
        step = np.linalg.solve(damped, slope)
        theirs = self._with_lean(derivatives(seen.map, seen.counts)).reshape(flat.shape)
        observed = np.zeros_like(hessian)
        for gain, mine, other in zip(np.repeat(seen.gains, [2, 1]), flat, theirs, strict=True):
            observed += gain * (mine @ other.T)
        inverse = bounded_inverse((observed + observed.T) / 2, hessian)
        terms = np.einsum("cphw,chw->phw", jacobian, residual)
        sums = self._template.block_sums(terms).astype(np.float64)
        spread = sums @ sums.T * (BLOCKS**2 / (BLOCKS**2 - POSE - LEAN))
        to_map = self._to_map(pose)
        moved = to_map @ inverse
        return LeanStep(-to_map @ step, np.asarray(moved @ spread @ moved.T))

    def _with_lean(self, jacobian: NDArray[np.float32]) -> NDArray[np.float32]:
        """Derivatives (3, 4, H, W) with those of the bends behind them: (3, 6, H, W)."""
        out = np.empty((len(jacobian), POSE + LEAN, *jacobian.shape[2:]), np.float32)
        out[:, :POSE] = jacobian
        for number, (x, y) in enumerate(self._bent):
            out[:, POSE + number] = jacobian[:, 0] * x + jacobian[:, 1] * y
        return out

    def _to_map(self, pose: Pose) -> Array:
        """From steps of the window, bends free of pose, to level-0 px, turn, log scale, lean."""
        whole = np.eye(POSE + LEAN)
        whole[:POSE, POSE:] = -self._shares.T
        out = np.eye(POSE + LEAN)
        out[:2, :2] = pose.linear * 2.0**self._template.level
        return np.asarray(out @ whole)


def _beyond_pose(fields: NDArray[np.float32], mask: NDArray[np.float32]) -> tuple[Array, Array]:
    """Fields (2, 2, H, W) less what a change of pose does too, and what that is, (2, 4).

    Without this a lean and a move would be nearly the same, and neither be known.
    """
    counted = np.concatenate([mask.ravel(), mask.ravel()]).astype(np.float64)
    basis = basis_fields(mask.shape).reshape(POSE, -1).astype(np.float64)
    flat = fields.reshape(LEAN, -1).astype(np.float64)
    shares = np.linalg.solve((basis * counted) @ basis.T, (basis * counted) @ flat.T).T
    bent = np.asarray(flat - shares @ basis, np.float64).reshape(fields.shape)
    return bent, np.asarray(shares, np.float64)
