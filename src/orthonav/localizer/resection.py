"""Position, height, heading, pitch and roll of a camera from blocks of a registered view.

Resection by linearized least squares: each block of the view pulls towards where it lies on the map
(`orthonav.register.refine.Refiner.pulls`), the telemetry holds height and attitude within their
standard deviations. Blocks that pull against the others count less (Huber).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera
from orthonav.localizer.orthorectify import Orientation

STEPS = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Steps of the numerical derivatives: metres east, north, up, degrees of heading, pitch, roll."""
GROUND_STEP_M = 2.0
"""The same of a point along the ground: about the noise of a terrain model over its slope."""
HUBER = 1.5
"""Blocks farther off than so many standard deviations count less."""
CORRELATED = 10.0
"""Errors of blocks are not independent, for those of terrain and imagery reach over several: the
variance is so many times larger. Neither are curvatures: those of the view also hold noise and what
changed, and the derivatives that map and view share were 0.8 of them, 0.3 to 1.2 by direction.
Chosen on `python -m benchmarks.pixel_ellipses --seed 1 --area 3`, scored on other ground."""
REWEIGHTED = 3
MIN_BLOCKS = 8
"""Fewer blocks do not show an attitude."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resection:
    """A correction (6,) of metres east, north, up and degrees of heading, pitch and roll, and the
    covariance (6, 6) of what it corrects."""

    correction: Array
    covariance: Array


def resected(
    camera: Camera,
    orientation: Orientation,
    ground_m: Array,
    slopes: Array,
    pulls: tuple[Array, Array],
    prior: tuple[Array, Array],
) -> Resection | None:
    """The camera at which the blocks of a view lie on the ground that they show.

    `ground_m` (N, 3): middles of the blocks on the terrain, east, north, above sea; `slopes`
    (N, 2): its rise per metre east and north there. `pulls`: what moves them over the ground, as
    gradient (N, 2) and curvature (N, 2, 2) of the score by metres east and north. `prior`: expected
    correction (6,) and its information (6, 6). None where too few blocks are seen.
    """
    moved = _moved_by_camera(camera, orientation, ground_m, slopes)
    gradient, curvature = pulls
    used = np.isfinite(moved).all(axis=(1, 2)) & (np.trace(curvature, axis1=1, axis2=2) > 0)
    if used.sum() < MIN_BLOCKS:
        return None
    moved, gradient, curvature = moved[used], gradient[used], curvature[used]
    own = np.trace(curvature, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(curvature + 0.02 * own * np.eye(2))
    weights = np.ones(len(moved))
    variance, correction = 1.0, np.zeros(6)
    for _ in range(REWEIGHTED):
        scaled = weights / variance
        normal = np.einsum("n,nip,nij,njq->pq", scaled, moved, curvature, moved)
        slope = np.einsum("n,nip,ni->p", scaled, moved, gradient)
        mean, information = prior
        covariance = np.linalg.inv(normal + information)
        correction = covariance @ (slope + information @ mean)
        left = gradient - np.einsum("nij,njp,p->ni", curvature, moved, correction)
        off = np.einsum("ni,nij,nj->n", left, inverse, left)
        # Two numbers of each block; the median of chi squared of two is 2 ln 2.
        alone = max(float(np.median(off)) / (2 * np.log(2)), 1e-12)
        variance = CORRELATED * alone
        weights = np.minimum(1.0, HUBER / np.maximum(np.sqrt(off / (2 * alone)), 1e-9))
    return Resection(correction, covariance)


def _moved_by_camera(
    camera: Camera, orientation: Orientation, ground_m: Array, slopes: Array
) -> Array:
    """How far (N, 2, 6) what is seen at an image point moves over the ground with the camera."""
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
