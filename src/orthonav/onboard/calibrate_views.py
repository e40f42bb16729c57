"""The mount of views that make no track, such as photographs taken far apart.

Each confident view shows its own pitch and roll (`orthonav.core.localize.camera`). The mount is
their robust mean over the reported values.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import Bias, Mount
from orthonav.core.localize.camera import tilt_std_deg
from orthonav.core.records import (
    CONFIDENT,
    DEFAULT_YAW_STD_DEG,
    Fix,
    NoFix,
    Telemetry,
    View,
    ViewResult,
)
from orthonav.onboard.calibrate import MAD_TO_STD, MIN_VIEWS, STD_FLOOR, MountCalibration
from orthonav.onboard.run import SingleViews

OUTLIER_SIGMAS = 3.0
"""Views that are off by more of their standard deviations, scatter included, do not count."""
ROUNDS = 10
"""Views are left out, and the mean is taken again, at most so many times."""
LEAST_SHARE = 0.1
"""A view counts for pitch and roll if it shows at least this share of what is known of them; the
rest is the reported value."""
_AXES = ("heading_deg", "log_scale", "pitch_deg", "roll_deg")
_UNKNOWN_HEADING = Bias(0.0, DEFAULT_YAW_STD_DEG, DEFAULT_YAW_STD_DEG)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordedSingleViews(SingleViews):
    """Locates every view on its own and keeps its telemetry; `reported` is that of all views."""

    reported: list[Telemetry] = field(default_factory=list)

    def locate(self, view: View) -> Fix | NoFix:
        """See `SingleViews.locate`."""
        self.reported.append(view.telemetry)
        return super().locate(view)

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """See `SingleViews.passed`."""
        if not self.reported or self.reported[-1] is not telemetry:  # else its `locate` failed
            self.reported.append(telemetry)
        return super().passed(telemetry, reason)


def calibrate_mount_by_views(
    results: Sequence[ViewResult], reported: Sequence[Telemetry]
) -> MountCalibration:
    """The mount of views that were located one by one, and their reported telemetry.

    The standard deviations of its biases contain the scatter from view to view. Raises
    `FlightError` where fewer than `MIN_VIEWS` confident views show their pitch and roll.
    """
    seen: list[tuple[ViewResult, list[list[float]]]] = []
    for result, telemetry in zip(results, reported, strict=True):
        fix = result.outcome
        if isinstance(fix, Fix) and fix.confidence >= CONFIDENT and fix.pose_cov is not None:
            shown = _biases(fix, fix.pose_cov, telemetry)
            if shown is not None:
                seen.append((result, shown))
    if len(seen) < MIN_VIEWS:
        raise FlightError(
            f"{len(seen)} of {len(results)} views have a confidence of {CONFIDENT} or more and "
            f"show their pitch and roll; a calibration needs {MIN_VIEWS}: check the map, the "
            "camera and the reported height"
        )
    biases = np.array([each for _, each in seen])
    heading, log_scale, pitch, roll = (
        robust_mean(biases[:, number, 0], biases[:, number, 1], STD_FLOOR[name])
        for number, name in enumerate(_AXES)
    )
    assert log_scale is not None and pitch is not None and roll is not None
    mount = Mount(heading or _UNKNOWN_HEADING, log_scale, pitch, roll, len(seen))
    return MountCalibration(mount, seen[0][0].frame, seen[-1][0].frame, moved=False)


def robust_mean(values: Array, variances: Array, floor: float) -> Bias | None:
    """Weighted mean of values (N,) without outliers; NaN are left out, None where all are.

    Its standard deviation, at least `floor`, is that of a mean of values which differ by their own
    variances (N,) and by the scatter that these do not explain.
    """
    known = np.isfinite(values) & np.isfinite(variances)
    values, variances = values[known], variances[known]
    if not len(values):
        return None
    middle, scatter2, used = float(np.median(values)), 0.0, np.ones(len(values), bool)
    for _ in range(ROUNDS):
        spread = MAD_TO_STD * float(np.median(np.abs(values[used] - middle)))
        scatter2 = max(0.0, spread**2 - float(np.median(variances[used])))
        weights = used / (variances + scatter2)
        middle = float(weights @ values / weights.sum())
        near = np.abs(values - middle) <= OUTLIER_SIGMAS * np.sqrt(variances + scatter2)
        if (near == used).all() or not near.any():
            break
        used = near
    std = math.sqrt(1.0 / float(weights.sum()))
    return Bias(middle, max(floor, std), math.sqrt(scatter2))


def _biases(fix: Fix, covariance: Array, telemetry: Telemetry) -> list[list[float]] | None:
    """True minus reported heading, log scale, pitch and roll, each with its variance (4, 2), by the
    view alone; None where it does not show pitch and roll."""
    variances = np.diag(covariance)
    turned = math.remainder(fix.heading_deg - telemetry.yaw_deg, 360.0)
    found = [
        [turned, float(variances[3])],
        [math.log(fix.agl_m / telemetry.agl_m), float(variances[2]) / fix.agl_m**2],
    ]
    prior = 1.0 / max(tilt_std_deg(telemetry), 1e-3) ** 2
    estimated = (fix.pitch_deg - telemetry.pitch_deg), (fix.roll_deg - telemetry.roll_deg)
    for off, variance in zip(estimated, variances[4:].tolist(), strict=True):
        # The estimate is the mean of the view and of the reported value, by their information.
        information = 1.0 / variance - prior
        if not information >= LEAST_SHARE / variance:
            return None
        found.append([off / variance / information, 1.0 / information])
    return found
