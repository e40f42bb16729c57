"""Calibration of a mount from a track, and correction of telemetry with it."""

import math

import numpy as np
import pytest

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import Bias, Mount
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, NoFix, Telemetry, TelemetryBias, View, ViewResult
from orthonav.core.track import Model
from orthonav.ground.recordings.calibrate import calibrate_mount
from orthonav.onboard.run import MountCorrected, model_of

CAMERA = Camera(4, 4, 4.0, 4.0, 2.0, 2.0)
TRUE = {"heading_bias": 4.0, "log_scale_bias": -0.1, "pitch_bias": 6.0, "roll_bias": -1.0}
SCATTER = {"heading_bias": 1.5, "log_scale_bias": 0.02, "pitch_bias": 0.4, "roll_bias": 0.4}


def view(number, values, confidence=0.99, std=0.5):
    biases = {}
    for name, value in values.items():
        unit = "" if name == "log_scale_bias" else "_deg"
        biases[f"{name}{unit}"] = value
        biases[f"{name}_std{unit}"] = std * (0.01 if name == "log_scale_bias" else 1.0)
    bias = TelemetryBias(**biases)
    fix = Fix(48.0, 2.0, np.eye(2), confidence, 35.0, 0.0, 100.0, bias=bias)
    return ViewResult(f"{number:03d}.jpg", number * 10**9, fix, 50.0, "tracking")


def flight(count=40, seed=0, true=TRUE, first=0):
    rng = np.random.default_rng(seed)
    return [
        view(first + n, {name: true[name] + rng.normal(0, SCATTER[name]) for name in TRUE})
        for n in range(count)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_biases_are_estimated(seed):
    found = calibrate_mount(flight(seed=seed))
    mount = found.mount
    assert mount.heading_deg.value == pytest.approx(4.0, abs=3 * mount.heading_deg.std)
    assert mount.log_scale.value == pytest.approx(-0.1, abs=3 * mount.log_scale.std)
    assert mount.pitch_deg.value == pytest.approx(6.0, abs=0.4)
    assert mount.heading_deg.scatter == pytest.approx(1.5, rel=0.5)
    assert (mount.views, found.first, found.last, found.moved) == (40, "000.jpg", "039.jpg", False)


def test_outliers_and_views_of_low_confidence_do_not_count():
    doubtful = [view(n, {**TRUE, "pitch_bias": 20.0}, confidence=0.5) for n in range(30)]
    missing = [ViewResult("x.jpg", 0, NoFix("blank", "it is blank"), 1.0, "lost")]
    results = doubtful + flight(10, first=30) + missing
    results[35] = view(35, {**TRUE, "heading_bias": 120.0})
    mount = calibrate_mount(results).mount
    assert mount.views == 10 and mount.pitch_deg.value == pytest.approx(6.0, abs=0.5)
    assert mount.heading_deg.value == pytest.approx(4.0, abs=2.0)
    with pytest.raises(FlightError, match="4 of 35 views"):
        calibrate_mount(doubtful + flight(4) + missing)


def test_a_moved_mount_is_that_at_the_end():
    before = flight(20, true={**TRUE, "pitch_bias": -3.0})
    found = calibrate_mount(before + flight(20, seed=1, first=20))
    assert found.moved and found.first == "020.jpg"
    assert found.mount.pitch_deg.value == pytest.approx(6.0, abs=0.5)


MOUNT = Mount(
    Bias(4.0, 0.5, 1.0), Bias(0.1, 0.01, 0.02), Bias(6.5, 0.8, 0.7), Bias(-1.0, 0.4, 0.5), 17
)


class Recording:
    """A locator that records the telemetry of its views."""

    def __init__(self):
        self.telemetry, self.state_name = [], "tracking"

    def locate(self, view):
        self.telemetry.append(view.telemetry)

    def passed(self, telemetry, reason):
        self.telemetry.append(telemetry)
        return reason


def test_a_mount_corrected_locator_gets_corrected_telemetry():
    mounted = MountCorrected(locator := Recording(), MOUNT)
    telemetry, reason = Telemetry(0, 10.0, 0.0, 1.0, 100.0), NoFix("bad_image", "it is broken")
    mounted.locate(View(np.zeros((4, 4), np.uint8), CAMERA, telemetry))
    assert mounted.passed(telemetry, reason) is reason and mounted.state_name == "tracking"
    found = [(each.yaw_deg, each.pitch_deg, each.roll_deg) for each in locator.telemetry]
    assert found == [(14.0, 6.5, 0.0)] * 2


def test_the_model_has_the_deviations_of_the_mount():
    model = model_of(MOUNT)
    assert model.tilt_rad == pytest.approx(math.radians(0.8))
    assert model.heading_rad == pytest.approx(math.radians(1.0))
    assert model.log_scale == 0.02 and model.accel_mps2 == Model().accel_mps2
    assert model.off_mount == 0.0
