"""Constant errors of reported heading, height and tilt, estimated from the track of a flight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import Bias, Mount
from orthonav.core.records import CONFIDENT, Fix, NoFix, Telemetry, View, ViewResult
from orthonav.core.track import Model
from orthonav.onboard.run import Locator

MIN_VIEWS = 5
MOVED_DEG, MOVED_SIGMAS = 2.0, 3.0
"""A tilt that differs by more than both from that at the end shows that the camera moved."""
MAD_TO_STD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""
LEAST_TILT_DEG = 0.1
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
    values = {name: _column(confident, key) for name, key in _EVIDENCE.items()}
    spreads = {
        name: _column(confident, key.replace("bias", "bias_std")) for name, key in _EVIDENCE.items()
    }
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
    return [each for each in results if _is_confident(each)]


def _is_confident(result: ViewResult) -> bool:
    fix = result.outcome
    return isinstance(fix, Fix) and fix.confidence >= CONFIDENT and "pitch_bias_deg" in fix.evidence


def _column(confident: Sequence[ViewResult], key: str) -> Array:
    return np.array([each.outcome.evidence[key] for each in confident])


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


def model_of(mount: Mount) -> Model:
    """Model of a flight whose telemetry is corrected by a mount: the biases that remain have the
    standard deviations of the calibration."""
    heading, tilt = mount.heading_deg, max(mount.pitch_deg.std, mount.roll_deg.std)
    tilt_rad = math.radians(max(tilt, LEAST_TILT_DEG))
    return replace(
        Model().with_mount(tilt_rad),
        heading_rad=math.radians(max(heading.std, heading.scatter, 1.0)),
        log_scale=max(mount.log_scale.std, mount.log_scale.scatter, 0.01),
        off_mount=0.0,
    )


@dataclass(frozen=True)
class MountCorrected:
    """A locator whose telemetry is corrected by a mount; its fixes report the remaining biases."""

    locator: Locator
    mount: Mount

    def locate(self, view: View) -> Fix | NoFix:
        """See `Locator.locate`."""
        return self.locator.locate(replace(view, telemetry=self.mount.corrected(view.telemetry)))

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """See `Locator.passed`."""
        return self.locator.passed(self.mount.corrected(telemetry), reason)

    @property
    def state_name(self) -> str | None:
        """See `Locator.state_name`."""
        return self.locator.state_name
