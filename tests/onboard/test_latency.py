"""Flights of the fault suite over a known ground: nothing wrong is sent.

Most have a locator that is always right about where an image was exposed, but not when. The suite
itself, with all faults over generated landscapes: `python -m benchmarks.faults`.
"""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.fault_flights import CAMERA, Fault, FaultFlight, World
from benchmarks.fault_scenarios import CAMERA_FAULTS, COMBINED_FAULTS, TELEMETRY_FAULTS
from blots import AGL_M, GROUND, as_grey, known_map, rendered
from fake_autopilot import FakeLocator, fix

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Telemetry
from orthonav.onboard.fly import _with_latency
from orthonav.onboard.latency import LatencyMonitor

FAULTS = {each.name: each for each in (*CAMERA_FAULTS, *TELEMETRY_FAULTS, *COMBINED_FAULTS)}
FRAME = LocalFrame(48.0, 2.0)


def picture(place, attitude, agl_m, rng):
    grey = rendered(GROUND, place, attitude, agl_m, CAMERA)
    return as_grey(0.75 * grey + 30 + rng.normal(0, 5, grey.shape))


def right(flight):
    """A locator that knows where an image was exposed."""

    def where(view):
        lat_deg, lon_deg = FRAME.latlon_from_en(flight.path.place(flight.exposed_s))
        return fix(float(lat_deg), float(lon_deg), heading_deg=view.telemetry.yaw_deg)

    return FakeLocator(where)


def fly(fault, lead_s=8.0, recovery_s=0.0):
    world = World(None, FRAME, picture, 140.0, AGL_M, 20.0)
    flight = FaultFlight(world, fault, seed=3, lead_s=lead_s, recovery_s=recovery_s, locator=right)
    return flight, flight.fly()


def test_an_undisturbed_flight_keeps_its_messages_and_states_the_latency():
    flight, report = fly(Fault("none", "none", 12.0))
    sent, views = report.lead_in()
    assert sent >= 10 and sent + len(report.during()) >= 0.98 * (views + 60)
    assert report.worst_m() < 4.0
    assert set(report.withheld) == {"no_telemetry", "latency_unknown"}  # of the first images
    plain = flight.runner._latency.plain()
    assert plain == {"latency_ms": 120.0, "latency_std_ms": 30.0, "latency": "stated"}


def test_views_are_located_but_not_sent_until_images_agree():
    flight, report = fly(Fault("none", "none", 0.2), lead_s=1.8)
    assert report.sent == [] and set(report.withheld) == {"no_telemetry", "latency_unknown"}
    assert flight.runner.counter.total["processed"] >= 5


@pytest.mark.parametrize(("stated_s", "std_s"), [(None, 0.03), (0.12, 0.31)])
def test_a_latency_that_is_not_known_is_named(stated_s, std_s):
    monitor = LatencyMonitor(stated_s, std_s)
    assert not monitor.may_locate and monitor.reasons() == ["latency_unknown"]
    assert "latency_unknown: camera latency" in monitor.plain()["latency"]


def test_without_a_stated_latency_nothing_is_located_or_sent():
    flight, report = fly(replace(Fault("none", "none", 1.0), stated_s=None))
    assert report.sent == [] and set(report.withheld) == {"latency_unknown"}
    assert flight.runner.counter.total["processed"] == 0
    assert "latency_unknown" in flight.runner.health.reasons
    plain = flight.runner._latency.plain()
    assert plain["latency_ms"] is None and "--camera-latency-ms" in plain["latency"]


def test_a_step_of_the_latency_stops_the_messages():
    _, report = fly(FAULTS["2 s late without a gap"])
    assert report.wrong() == [] and len(report.during()) <= 5
    assert report.withheld["motion_mismatch"] > 50


def test_the_covariance_includes_the_latency():
    flight, report = fly(Fault("none", "none", 0.2), lead_s=7.0)
    assert report.sent
    values = np.linalg.eigvalsh(flight.gate._last.cov_en_m2)
    speed = np.hypot(flight.path.reported(22.0).north, flight.path.reported(22.0).east)
    assert values == pytest.approx([4.0, 4.0 + (0.03 * speed) ** 2], rel=0.03)


def test_the_confidence_includes_the_latency():
    """At 30 m/s an image 1 s off is 30 m off."""
    exact = replace(fix(48.0, 2.0), place_probability=0.999)
    later = _with_latency(exact, Telemetry(0, 0.0, 0.0, 0.0, 100.0, vel_en_mps=(30.0, 0.0)), 1.0)
    assert later.confidence == later.probability_within(exact.radius_m) < exact.confidence - 0.1


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("2 s late from the start", 0),
        ("mirrored", 12),
        pytest.param("rotated by 180 deg", 12, marks=pytest.mark.slow),
        ("frozen with noise", 12),
    ],
)
@pytest.mark.long
def test_images_that_do_not_move_as_reported_stop_the_messages(name, most):
    _, report = fly(FAULTS[name], recovery_s=20.0)
    assert report.wrong() == [] and len(report.during()) <= most
    assert report.recovery_s() < 12.0


@pytest.fixture(scope="module")
def world(made_once, make_ortho):
    _, path, frame = known_map(made_once, make_ortho)
    return World(Localizer(open_map(path)), frame, picture, 140.0, AGL_M, 20.0)


@pytest.mark.long
def test_pictures_that_show_nothing_of_the_map_give_no_wrong_message(world):
    fault = FAULTS["mirrored, velocity reversed"]
    flight = FaultFlight(world, fault, seed=3, lead_s=9.0, recovery_s=0.0)
    flight.fault_s, flight.end_s = (9.0, 12.0), 12.0
    report = flight.fly()
    sent, views = report.lead_in()
    assert sent >= 0.95 * views >= 15  # it was tracking before
    assert max(each.error_m for each in report.sent if each not in report.during()) < 12.0
    assert report.wrong() == [] and len(report.during()) <= 3


@pytest.mark.long
def test_the_suite_notices_a_wrong_message(world):
    """A map that is displaced by 60 m cannot be noticed: its messages count as wrong."""
    fault = Fault("shifted", "map", 8.0, from_start=True, ground_en_m=(60.0, 0.0))
    report = FaultFlight(world, fault, seed=3, lead_s=9.0, recovery_s=0.0).fly()
    assert len(report.wrong()) > 5 and report.worst_m() == pytest.approx(60.0, abs=8.0)
    assert np.isinf(report.recovery_s())
