"""What is wrong with what a flight tells all along, from the track of that flight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import FlightError
from orthonav.flight.mount import Bias, Mount
from orthonav.onboard.run import Locator
from orthonav.records import CONFIDENT, Fix, NoFix, Telemetry, View, ViewResult
from orthonav.track import Model

MIN_VIEWS = 5
MOVED_DEG, MOVED_SIGMAS = 2.0, 3.0
"""A mount that differs by more than both from what it is in the end has moved meanwhile."""
MAD_TO_STD = 1.4826
LEAST_TILT_DEG = 0.1
STD_FLOOR = {"heading_deg": 0.2, "log_scale": 0.003, "pitch_deg": 0.3, "roll_deg": 0.3}
_LASTING = ("pitch_deg", "roll_deg")
_EVIDENCE = {
    "heading_deg": "heading_bias_deg",
    "log_scale": "log_scale_bias",
    "pitch_deg": "pitch_bias_deg",
    "roll_deg": "roll_bias_deg",
}
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """A mount, the frames of its first and last view, and whether it had moved before those."""

    mount: Mount
    first: str
    last: str
    moved: bool


def calibrated(results: Sequence[ViewResult]) -> Calibration:
    """The mount at the end of a flight that was tracked, from its confident views.

    Views before the camera moved in its mount are left out. Medians are taken, so that single
    views do not matter; their standard deviation counts views that err alike as fewer.
    Raises `FlightError` where fewer than `MIN_VIEWS` views are confident.
    """
    sure = [each for each in results if _is_confident(each)]
    if len(sure) < MIN_VIEWS:
        raise FlightError(
            f"{len(sure)} of {len(results)} views have a confidence of {CONFIDENT}; a calibration "
            f"needs {MIN_VIEWS}: is it the right map, camera and height?"
        )
    values = {name: _column(sure, key) for name, key in _EVIDENCE.items()}
    spreads = {
        name: _column(sure, key.replace("bias", "bias_std")) for name, key in _EVIDENCE.items()
    }
    begin = max(_still_from(values[name], spreads[name]) for name in ("pitch_deg", "roll_deg"))
    begin = min(begin, len(sure) - MIN_VIEWS)
    kept = slice(begin, None)
    biases = {
        name: _bias(values[name][kept], spreads[name][kept], STD_FLOOR[name], name in _LASTING)
        for name in _EVIDENCE
    }
    mount = Mount(**biases, views=len(sure) - begin)
    return Calibration(mount, sure[begin].frame, sure[-1].frame, begin > 0)


def _is_confident(result: ViewResult) -> bool:
    fix = result.outcome
    return isinstance(fix, Fix) and fix.confidence >= CONFIDENT and "pitch_bias_deg" in fix.evidence


def _column(sure: Sequence[ViewResult], key: str) -> Array:
    return np.array([each.outcome.evidence[key] for each in sure])


def _still_from(values: Array, spreads: Array) -> int:
    """The first of the last views between which a value hardly changes."""
    end = float(np.median(values[-MIN_VIEWS:]))
    far = np.abs(values - end) > np.maximum(MOVED_SIGMAS * spreads, MOVED_DEG)
    return int(np.flatnonzero(far)[-1]) + 1 if far.any() else 0


def _bias(values: Array, spreads: Array, floor: float, lasting: bool) -> Bias:
    """Median, how well it is known, and the scatter around it.

    What is `lasting` in the track is known as well as the track knew it; what scatters from view to
    view, as well as the mean of so many views, fewer where neighbours err alike.
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
    """The model of a flight whose told values are corrected by a mount: no better known than that,
    and not off by something else."""
    heading, tilt = mount.heading_deg, max(mount.pitch_deg.std, mount.roll_deg.std)
    tilt_rad = math.radians(max(tilt, LEAST_TILT_DEG))
    return replace(
        Model().with_mount(tilt_rad),
        heading_rad=math.radians(max(heading.std, heading.scatter, 1.0)),
        log_scale=max(mount.log_scale.std, mount.log_scale.scatter, 0.01),
        off_mount=0.0,
    )


@dataclass(frozen=True)
class Mounted:
    """A locator that is told everything corrected by a mount.

    What its fixes call wrong with what is told is what is left.
    """

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
