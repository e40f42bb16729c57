"""Tilt that the telemetry does not report: of the camera mount and of the autopilot's horizon."""

import math

import numpy as np
import pytest
from simulated import route_of

from orthonav.core.flight import open_flight
from orthonav.ground.simulate.flight import Errors
from orthonav.ground.simulate.motion import HORIZON_TIME_S


@pytest.fixture
def tilts(fly):
    """Flies, and gives true pitch and roll of the camera (N, 2) and the telemetry."""

    def flown(**request):
        flight, _, asked = fly(pictures=False, **request)
        true = [arguments[3].attitude[1:3] for arguments in asked]
        return np.array(true), [view.telemetry for view in flight.views]

    return flown


def test_the_mount_is_constant_and_of_the_stated_size(tilts):
    errors = Errors(mount_std_deg=2.0)
    biased = Errors(mount_std_deg=2.0, pitch_bias_deg=3.0, roll_bias_deg=-4.0)
    assert biased.mount_deg(1) - errors.mount_deg(1) == pytest.approx([3.0, -4.0])
    for seed in range(3):
        true, reported = tilts(random=2, seed=seed, errors=errors)
        assert true == pytest.approx(np.tile(errors.mount_deg(seed), (2, 1)), abs=1e-9)
        assert all((t.pitch_deg, t.roll_deg, t.tilt_std_deg) == (0, 0, None) for t in reported)
    mounts = np.array([errors.mount_deg(seed) for seed in range(400)])
    assert mounts.std(axis=0) == pytest.approx([2.0, 2.0], rel=0.15)
    assert np.abs(mounts.mean(axis=0)).max() < 4 * 2.0 / math.sqrt(400)


def test_the_horizon_wanders_along_a_route(tilts, frame):
    corners = [((-1) ** (n // 2) * 400.0, -400.0 + 80.0 * ((n + 1) // 2)) for n in range(18)]
    route = route_of(frame, *corners)
    true, reported = tilts(route=route, spacing_m=40.0, errors=Errors(horizon_std_deg=1.5))
    assert len(true) > 150
    assert 0.7 < true.std() < 2.3
    step_s = (reported[1].time_ns - reported[0].time_ns) / 1e9
    changes = np.diff(true, axis=0)
    expected = 1.5 * math.sqrt(2 * (1 - math.exp(-step_s / HORIZON_TIME_S)))
    assert changes.std() == pytest.approx(expected, rel=0.2)
    assert {(t.pitch_deg, t.roll_deg, t.tilt_std_deg) for t in reported} == {(0.0, 0.0, None)}


def test_what_the_telemetry_states(tilts):
    stated = {
        0.0: Errors(),
        None: Errors(mount_std_deg=1.0, horizon_std_deg=1.0),
        0.5: Errors(tilt_std_deg=0.5, mount_std_deg=1.0, horizon_std_deg=1.0),
    }
    for std, errors in stated.items():
        _, reported = tilts(random=2, errors=errors)
        assert {t.tilt_std_deg for t in reported} == {std}
    assert Errors(pitch_bias_deg=1.0).reported_tilt_std_deg is None
    assert Errors(attitude_std_deg=3.0).reported_tilt_std_deg == 0


def test_the_command_tilts_by_default(run, ortho, tmp_path):
    fly = ["simulate", "--ortho", ortho, "--random", "3", "--agl-m", "100"]
    exact = ["--unreported-tilt-deg", "0"]
    pictures = {}
    for name, options, stated in (("usual", [], None), ("exact", exact, 0.0)):
        assert run(*fly, *options, "--out", tmp_path / name).code == 0
        views = open_flight(tmp_path / name).views
        reported = [view.telemetry for view in views]
        assert {(t.pitch_deg, t.roll_deg, t.tilt_std_deg) for t in reported} == {(0, 0, stated)}
        pictures[name] = [view.data() for view in views]
    assert not set(pictures["usual"]) & set(pictures["exact"])
