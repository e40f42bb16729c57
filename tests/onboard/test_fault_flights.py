"""Some flights of the fault suite over a known ground: no message is wrong.

The suite itself, with all faults over generated landscapes: `python -m benchmarks.faults`.
"""

import numpy as np
import pytest
from benchmarks.fault_flights import CAMERA, Fault, FaultFlight, World
from benchmarks.fault_scenarios import CAMERA_FAULTS, COMBINED_FAULTS, TELEMETRY_FAULTS
from blots import AGL_M, GROUND, as_grey, known_map, rendered

from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map

pytestmark = pytest.mark.long

FAULTS = {each.name: each for each in (*CAMERA_FAULTS, *TELEMETRY_FAULTS, *COMBINED_FAULTS)}
LEAD_S = 9.0


def picture(place, attitude, agl_m, rng):
    grey = rendered(GROUND, place, attitude, agl_m, CAMERA)
    return as_grey(0.75 * grey + 30 + rng.normal(0, 5, grey.shape))


@pytest.fixture(scope="module")
def world(made_once, make_ortho):
    _, path, frame = known_map(made_once, make_ortho)
    localizer = Localizer(open_map(path))
    return World(localizer, frame, picture, 140.0, AGL_M, 20.0)


def fly(world, fault, recovery_s, seconds=None):
    flight = FaultFlight(world, fault, seed=3, lead_s=LEAD_S, recovery_s=recovery_s)
    if seconds is not None:
        flight.fault_s = flight.fault_s[0], flight.fault_s[0] + seconds
        flight.end_s = flight.fault_s[1] + recovery_s
    return flight.fly()


@pytest.mark.parametrize(
    "name",
    [
        "mirrored, velocity reversed",
        pytest.param("cloud, velocity 3 m/s off", marks=pytest.mark.slow),
    ],
)
def test_pictures_that_show_nothing_of_the_map_give_no_wrong_message(world, name):
    report = fly(world, FAULTS[name], 0.0, seconds=3.0)
    sent, views = report.lead_in()
    assert sent >= 0.95 * views >= 15  # it was tracking before
    assert max(each.error_m for each in report.sent if each not in report.during()) < 12.0
    assert report.wrong() == [] and len(report.during()) <= 3


def test_the_suite_notices_a_wrong_message(world):
    """A map that is displaced by 60 m cannot be noticed: its messages count as wrong."""
    fault = Fault("shifted", "map", 8.0, from_start=True, ground_en_m=(60.0, 0.0))
    report = fly(world, fault, 0.0)
    assert len(report.wrong()) > 5 and report.worst_m() == pytest.approx(60.0, abs=8.0)
    assert np.isinf(report.recovery_s())
