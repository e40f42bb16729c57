"""Telemetry interpolated to the exposure, and the offset of the clocks."""

import math

import numpy as np
import pytest
from fake_autopilot import MS, S
from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.geo.attitude import enu_from_body_camera, ned_from_angles, wxyz_of_angles
from orthonav.ground.recordings.telemetry_track import RecordedTrack, Samples, attitude_of_angles
from orthonav.onboard import telemetry
from orthonav.onboard.telemetry import ClockSync, TelemetryBuffer

ANGLES = st.tuples(st.floats(-180, 180), st.floats(-40, 40), st.floats(-40, 40))


def attitude(buffer, time_ns, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
    buffer.add_attitude(time_ns, wxyz_of_angles(np.radians([yaw_deg, pitch_deg, roll_deg])))


@given(ANGLES, st.tuples(*[st.floats(-30, 30)] * 3))
def test_telemetry_equals_that_of_an_imported_log(angles, mount):
    yaw, pitch, roll = angles
    buffer, samples = TelemetryBuffer(), Samples(3)
    attitude(buffer, 1 * S, yaw, pitch, roll)
    samples.add(1 * S, yaw, pitch, roll)
    series = attitude_of_angles(samples, lambda a: enu_from_body_camera(ned_from_angles(a), mount))
    logged = RecordedTrack(series).telemetry(1 * S)
    telemetry = buffer.at(1 * S).telemetry(1 * S, mount)
    assert (telemetry.pitch_deg, telemetry.roll_deg) == pytest.approx(
        (logged.pitch_deg, logged.roll_deg)
    )
    assert math.remainder(telemetry.yaw_deg - logged.yaw_deg, 360) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("every_ms, known", [(20, True), (50, True), (100, False)])
def test_dense_attitudes_are_extrapolated_a_little(every_ms, known):
    """A view need not wait for the next one; it turns on as it turned."""
    buffer = TelemetryBuffer()
    for number in range(5):
        attitude(buffer, number * every_ms * MS, yaw_deg=number * every_ms * 0.1)
    last_ns = 4 * every_ms * MS
    assert buffer.covered_ns == last_ns + (30 * MS if known else 0)
    telemetry = buffer.at(last_ns + 20 * MS).telemetry(0)
    expected = (4 * every_ms + (20 if known else 0)) * 0.1  # else as it was last
    assert telemetry.yaw_deg == pytest.approx(expected, abs=1e-6)
    later = buffer.at(last_ns + 50 * MS).telemetry(0)
    assert later.yaw_deg == pytest.approx(4 * every_ms * 0.1)


def test_gaps_are_not_interpolated():
    buffer = TelemetryBuffer()
    assert buffer.at(0).ned_from_body is None and buffer.covered_ns is None
    attitude(buffer, 1 * S)
    attitude(buffer, 2 * S)
    buffer.add_height("home", 1 * S, 100.0)
    buffer.add_height("home", 2 * S, 110.0)
    assert buffer.at(1 * S - 1).ned_from_body is None
    gap = buffer.at(1500 * MS)
    assert gap.ned_from_body is None and gap.height_m == pytest.approx(105.0)
    assert gap.telemetry(0).missing() == ["yaw_deg", "pitch_deg", "roll_deg"]
    assert buffer.at(2100 * MS).ned_from_body is not None
    late = buffer.at(2101 * MS)
    assert late.ned_from_body is None and late.height_m == 110.0
    assert math.isnan(buffer.at(3501 * MS).height_m)


def test_the_best_available_height_is_used():
    buffer = TelemetryBuffer()
    attitude(buffer, 0)
    buffer.add_height("relative", 0, 1.0)
    assert buffer.at(0).height_m == 1.0
    buffer.add_height("home", 0, 2.0)
    assert buffer.at(0).height_m == 2.0
    buffer.add_height("terrain", 0, 3.0)
    buffer.add_height("distance", 10, math.nan)
    assert buffer.at(0).height_m == 3.0
    buffer.add_distance(10, 4.0)
    assert buffer.at(10).height_m == 4.0
    only = TelemetryBuffer(heights=("home",))
    only.add_height("terrain", 0, 3.0)
    assert math.isnan(only.at(0).height_m)


def test_a_distance_is_corrected_for_the_tilt():
    buffer = TelemetryBuffer()
    buffer.add_distance(0, 100.0)  # the tilt is not known
    assert math.isnan(buffer.at(0).height_m)
    attitude(buffer, 1, pitch_deg=20.0, roll_deg=10.0)
    buffer.add_distance(1, 100.0)
    tilt = math.cos(math.radians(20)) * math.cos(math.radians(10))
    assert buffer.at(1).height_m == pytest.approx(100 * tilt)


def circling(time_ns):
    """Velocity north, east, down of an aircraft that turns once in 20 s."""
    angle = math.tau * time_ns / (20 * S)
    return 20 * math.cos(angle), 20 * math.sin(angle), 0.0


def test_the_mean_velocity_follows_turns(monkeypatch):
    monkeypatch.delattr(np, "trapezoid", raising=False)  # NumPy 1.26 does not have it
    buffer = TelemetryBuffer()
    for time_ns in range(0, 50 * S + 1, 40 * MS):
        buffer.add_local(time_ns, circling(time_ns), 0.0)
    across_m = 20 * 20 / math.pi  # half a turn more than two
    assert buffer.mean_velocity(0, 50 * S) == pytest.approx((across_m / 50, 0.0), abs=0.01)
    last = buffer.mean_velocity(50 * S - 30 * MS, 50 * S)
    assert last == pytest.approx((0.0, -20.0), abs=0.2)


def test_the_mean_velocity_is_not_known_across_gaps_and_restarts():
    buffer = TelemetryBuffer()
    later = round(telemetry.SLOW_GAP_S * S) + 1
    for time_ns, speed in ((0, 10.0), (later, 10.0), (later + S, 1e20), (later + 2 * S, 10.0)):
        buffer.add_local(time_ns, (speed, 0.0, 0.0), 0.0)
    assert buffer.mean_velocity(0, later) is None
    assert buffer.mean_velocity(later, later + 2 * S) == (0.0, 10.0)
    assert buffer.mean_velocity(-S, 0) is None
    buffer.clear()
    assert buffer.mean_velocity(later, later + 2 * S) is None


@pytest.mark.parametrize("wxyz", [(0, 0, 0, 0), (math.nan, 0, 0, 0), (3, 0, 0, 0)])
def test_an_invalid_attitude_is_dropped(wxyz):
    buffer = TelemetryBuffer()
    buffer.add_attitude(0, wxyz)
    assert buffer.covered_ns is None


def test_samples_out_of_order_and_old_ones_are_dropped(monkeypatch):
    monkeypatch.setattr(telemetry, "KEEP_NS", S)
    buffer = TelemetryBuffer()
    for number in range(1000):
        attitude(buffer, number * 10 * MS, yaw_deg=10.0)
    attitude(buffer, 5 * S, yaw_deg=90.0)
    assert buffer.covered_ns == 9990 * MS + telemetry.ATTITUDE_AHEAD_NS
    assert buffer.at(5 * S).ned_from_body is None
    assert buffer.at(9500 * MS).telemetry(0).yaw_deg == pytest.approx(10.0)
    assert len(buffer._attitude.times) <= 201


OFFSET_NS = -37 * S


def offset_ns(sync, at_ns=0):
    return sync.boot_ns(at_ns) - at_ns


def exchanges(sync, rng, count, offset_ns=OFFSET_NS, start_ns=0, one_sided=False):
    jumped = False
    for number in range(count):
        sent = start_ns + number * S
        there = round(rng.exponential(3 * MS)) + MS
        back = MS if one_sided else round(rng.exponential(3 * MS)) + MS
        jumped |= sync.exchange(sent, sent + there + back, sent + there + offset_ns)
    return jumped


@pytest.mark.parametrize("seed", range(5))
def test_exchanges_with_a_short_round_trip_are_used(seed):
    sync = ClockSync()
    exchanges(sync, np.random.default_rng(seed), 32)
    assert sync.is_exact and abs(offset_ns(sync) - OFFSET_NS) < MS


def test_outliers_are_ignored():
    sync, rng = ClockSync(), np.random.default_rng(1)
    exchanges(sync, rng, 10)
    before = offset_ns(sync)
    for late in (300 * MS, -300 * MS, 10 * S):
        sync.exchange(20 * S, 20 * S + 2 * MS, 20 * S + OFFSET_NS + late)
    sync.exchange(20 * S, 30 * S, 25 * S + OFFSET_NS)  # a round trip of 10 s
    sync.exchange(20 * S, 19 * S, 20 * S + OFFSET_NS)  # answered before it was asked
    assert (offset_ns(sync), sync.jumps) == (before, 0)


@pytest.mark.parametrize("jump_ns", [5 * S, -5 * S, 60 * MS, -60 * MS, -36 * S])
def test_a_clock_that_was_set_is_detected(jump_ns):
    sync, rng = ClockSync(), np.random.default_rng(2)
    exchanges(sync, rng, 20)
    assert exchanges(sync, rng, 8, OFFSET_NS + jump_ns, 20 * S)
    assert sync.jumps == 1
    exchanges(sync, rng, 5, OFFSET_NS + jump_ns, 30 * S)
    assert abs(offset_ns(sync) - OFFSET_NS - jump_ns) < 3 * MS


@pytest.mark.parametrize("jump_ns", [5 * S, -5 * S])
def test_a_restart_is_detected_from_timestamps_of_messages(jump_ns):
    sync, rng = ClockSync(), np.random.default_rng(3)
    for number in range(100):
        now = number * 20 * MS
        sync.heard(now + round(rng.exponential(10 * MS)), now + OFFSET_NS)
    assert abs(offset_ns(sync) - OFFSET_NS) < MS and not sync.is_exact
    for number in range(100):
        now = 2 * S + number * 20 * MS
        sync.heard(now + round(rng.exponential(10 * MS)), now + OFFSET_NS + jump_ns)
    assert sync.jumps == 1 and abs(offset_ns(sync) - OFFSET_NS - jump_ns) < 15 * MS


def test_a_queue_that_empties_is_no_jump():
    """The link stood still for three seconds, then all comes at once."""
    sync = ClockSync()
    exchanges(sync, np.random.default_rng(4), 5)
    before = offset_ns(sync)
    for number in range(150):
        sync.heard(10 * S + number * MS, 7 * S + number * 20 * MS + OFFSET_NS)
    assert (sync.jumps, offset_ns(sync)) == (0, before)


@pytest.mark.parametrize("rate", [-0.022, 0.03, 2e-5])
def test_clocks_of_different_rates(rate):
    """PX4's simulator in lockstep runs 2 % slow."""
    sync, rng = ClockSync(), np.random.default_rng(5)

    def boot_ns(now_ns):
        return OFFSET_NS + now_ns + round(rate * now_ns)

    for number in range(60):
        sent = number * S
        there, back = (MS + round(rng.exponential(2 * MS)) for _ in range(2))
        assert not sync.exchange(sent, sent + there + back, boot_ns(sent + there))
        sync.heard(sent + S // 2, boot_ns(sent + S // 2 - 5 * MS))
        if number > 8:
            for at_ns in (sent + S, sent - 5 * S):
                assert abs(sync.boot_ns(at_ns) - boot_ns(at_ns)) < 8 * MS
                assert abs(sync.mono_ns(boot_ns(at_ns)) - at_ns) < 8 * MS
    assert sync.jumps == 0
