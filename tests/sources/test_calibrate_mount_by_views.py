"""The mount from single views: what they show without the reported tilt, robustly averaged."""

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, NoFix, Telemetry, View, ViewResult
from orthonav.ground.recordings.calibrate_mount import (
    RecordedSingleViews,
    calibrate_mount_by_views,
)

CAMERA = Camera(4, 4, 4.0, 4.0, 2.0, 2.0)
MOUNT = {"heading": 4.0, "log_scale": -0.05, "pitch": 5.0, "roll": -1.5}
HORIZON_DEG, REPORTED_STD_DEG = 0.8, 3.0


def located(rng, number, std_deg, **true):
    """A view whose pitch and roll the picture shows to `std_deg`, estimated with the report."""
    true = MOUNT | true
    telemetry = Telemetry(number, 350.0, 2.0, -3.0, 100.0, tilt_std_deg=REPORTED_STD_DEG)
    seen = [true[name] + rng.normal(0, math.hypot(std_deg, HORIZON_DEG)) for name in MOUNT][2:]
    variance = 1 / (std_deg**-2 + REPORTED_STD_DEG**-2)
    pitch, roll = (each * variance / std_deg**2 for each in seen)
    heading = 350.0 + true["heading"] + rng.normal(0, 1.5)
    agl_m = 100.0 * math.exp(true["log_scale"] + rng.normal(0, 0.01))
    cov = np.diag([1.0, 1.0, 0.3**2, 0.1**2, variance, variance])
    fix = Fix(48.0, 2.0, np.eye(2), 0.99, 35.0, heading % 360, agl_m, MappingProxyType({}))
    fix = replace(fix, pitch_deg=2.0 + pitch, roll_deg=-3.0 + roll, pose_cov=cov)
    return ViewResult(f"{number:03d}.jpg", number, fix, 50.0), telemetry


def flight(count=30, seed=0, std_deg=1.0, **true):
    rng = np.random.default_rng(seed)
    return [located(rng, number, std_deg, **true) for number in range(count)]


def calibrated(seen):
    return calibrate_mount_by_views(*zip(*seen, strict=True))


def test_the_mount_is_the_mean_of_what_views_show():
    """Not of their estimates, which the reported tilt draws to 0."""
    off = []
    for seed in range(12):
        mount = calibrated(flight(seed=seed, std_deg=3.0)).mount
        off.append((mount.pitch_deg.value - 5.0) / mount.pitch_deg.std)
        off.append((mount.roll_deg.value + 1.5) / mount.roll_deg.std)
        assert mount.heading_deg.value == pytest.approx(4.0, abs=1.5)
        assert mount.log_scale.value == pytest.approx(-0.05, abs=0.01)
        assert mount.views == 30
    assert 0.4 < np.mean(np.square(off)) < 2.0 and abs(np.mean(off)) < 0.6


def test_outliers_and_views_of_low_confidence_do_not_count():
    wrong, telemetry = located(np.random.default_rng(5), 99, 0.5, pitch=40.0)
    found = calibrated([*flight(12, std_deg=0.5), (wrong, telemetry)])
    assert found.mount.pitch_deg.value == pytest.approx(5.0, abs=1.0)
    doubtful = replace(wrong, outcome=replace(wrong.outcome, confidence=0.5))
    blank = replace(wrong, outcome=NoFix("blank", "it is blank"))
    unseen = replace(wrong, outcome=replace(wrong.outcome, pose_cov=None))
    others = [(each, telemetry) for each in (doubtful, blank, unseen)]
    found = calibrated([*flight(12, std_deg=0.5), *others])
    assert (found.mount.views, found.first, found.last) == (12, "000.jpg", "011.jpg")
    assert not found.moved


def test_exact_views_weigh_more_and_uninformative_ones_not_at_all():
    seen = flight(20, std_deg=0.5) + flight(20, seed=1, std_deg=6.0, pitch=-4.0)
    assert calibrated(seen).mount.pitch_deg.value == pytest.approx(5.0, abs=1.0)
    with pytest.raises(FlightError, match="0 of 30 views"):
        calibrated(flight(std_deg=30.0))
    seen = [(result, replace(each, yaw_deg=math.nan)) for result, each in flight()]
    bias = calibrated(seen).mount.heading_deg
    assert bias.value == 0.0 and bias.std >= 5.0


def test_the_telemetry_of_every_view_is_kept_once():
    class Failing:
        def locate(self, view, *, prior, heading_known):
            if view.telemetry.time_ns == 1:
                raise ValueError("it failed")
            return NoFix("blank", "it is blank")

    alone, reason = RecordedSingleViews(Failing()), NoFix("bad_image", "it is broken")
    all_reported = [Telemetry(n, 0.0, 0.0, 0.0, 100.0) for n in range(3)]
    views = [View(np.zeros((4, 4), np.uint8), CAMERA, each) for each in all_reported]
    alone.locate(views[0])
    with pytest.raises(ValueError, match="it failed"):
        alone.locate(views[1])
    assert alone.passed(all_reported[1], reason) is reason
    assert alone.passed(all_reported[2], reason) is reason
    assert alone.reported == all_reported
