"""Constant errors of reported heading, height and tilt, estimated from the track of a flight."""

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
from orthonav.onboard.run import SingleViews

MIN_VIEWS = 5
MOVED_DEG, MOVED_SIGMAS = 2.0, 3.0
"""A tilt that differs by more than both from that at the end shows that the camera moved."""
MAD_TO_STD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""
STD_FLOOR = {"heading_deg": 0.2, "log_scale": 0.003, "pitch_deg": 0.3, "roll_deg": 0.3}
"""Lower bounds of the standard deviations of the estimated biases."""
_LASTING = ("pitch_deg", "roll_deg")
_EVIDENCE = {
    "heading_deg": "heading_bias_deg",
    "log_scale": "log_scale_bias",
    "pitch_deg": "pitch_bias_deg",
    "roll_deg": "roll_bias_deg",
}
Array = NDArray[np.float64]
OUTLIER_SIGMAS = 3.0
"""Views that are off by more of their standard deviations, scatter included, do not count."""
ROUNDS = 10  # views are left out, and the mean is taken again, at most so many times
LEAST_SHARE = 0.1
"""A view counts for pitch and roll if it shows at least this fraction of what is known of them; the
rest is the reported value."""
_UNKNOWN_HEADING = Bias(0.0, DEFAULT_YAW_STD_DEG, DEFAULT_YAW_STD_DEG)


@dataclass(frozen=True)
class MountCalibration:
    """A mount calibration.

    `mount`: estimated biases.
    `first`, `last`: frames of the first and the last view used.
    `moved`: whether the camera moved in its mount before `first`.
    """

    mount: Mount
    first: str
    last: str
    moved: bool


def calibrate_mount(results: Sequence[ViewResult]) -> MountCalibration:
    """Mount at the end of a tracked flight, estimated from its confident views.

    Views before a movement of the camera in its mount are excluded. Biases are medians; their
    standard deviations account for the correlation of successive views. Raises `FlightError` where
    fewer than `MIN_VIEWS` views are confident.
    """
    confident = confident_views(results)
    if len(confident) < MIN_VIEWS:
        raise FlightError(
            f"{len(confident)} of {len(results)} views have a confidence of {CONFIDENT} or more; a "
            f"calibration needs {MIN_VIEWS}: check the map, the camera and the reported height"
        )
    values, spreads = (
        {
            name: np.array([each.outcome.evidence[key.replace("bias", bias)] for each in confident])
            for name, key in _EVIDENCE.items()
        }
        for bias in ("bias", "bias_std")
    )
    begin = max(_still_from(values[name], spreads[name]) for name in ("pitch_deg", "roll_deg"))
    begin = min(begin, len(confident) - MIN_VIEWS)
    used = slice(begin, None)
    biases = {
        name: _bias(values[name][used], spreads[name][used], STD_FLOOR[name], name in _LASTING)
        for name in _EVIDENCE
    }
    mount = Mount(**biases, views=len(confident) - begin)
    return MountCalibration(mount, confident[begin].frame, confident[-1].frame, begin > 0)


def confident_views(results: Sequence[ViewResult]) -> list[ViewResult]:
    """Confident views of a track that state their biases."""
    return [
        each
        for each in results
        if isinstance(each.outcome, Fix)
        and each.outcome.confidence >= CONFIDENT
        and "pitch_bias_deg" in each.outcome.evidence
    ]


def _still_from(values: Array, spreads: Array) -> int:
    """Index of the first view from which on a value stays close to that at the end."""
    end = float(np.median(values[-MIN_VIEWS:]))
    far = np.abs(values - end) > np.maximum(MOVED_SIGMAS * spreads, MOVED_DEG)
    return int(np.flatnonzero(far)[-1]) + 1 if far.any() else 0


def _bias(values: Array, spreads: Array, floor: float, lasting: bool) -> Bias:
    """Median, its standard deviation, and the scatter around it.

    The standard deviation of a `lasting` bias is that of the track. Otherwise it is that of the
    mean of the views, their number reduced by the autocorrelation at lag one.
    """
    middle = float(np.median(values))
    off = values - middle
    scatter = MAD_TO_STD * float(np.median(np.abs(off)))
    if lasting:
        return Bias(middle, max(floor, float(np.median(spreads))), scatter)
    energy = float(off @ off)
    alike = float(off[1:] @ off[:-1]) / energy if energy > 0 else 0.0
    alike = min(max(alike, 0.0), 0.99)
    mean_std = scatter * math.sqrt((1 + alike) / (1 - alike) / len(values))
    return Bias(middle, max(floor, mean_std), scatter)


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
        for number, name in enumerate(_EVIDENCE)
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
