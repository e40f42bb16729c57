"""The GNSS monitor: each fault is named in time, and a good receiver is never named.

Receivers and positions of the map are simulated with correlated errors; no images are involved.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.gnss_watch import FRAME, MAPS, delay, false_alarms, fed, lawnmower, map_positions

from orthonav.core.flight.gnss import Fault, GnssSample
from orthonav.ground.simulate.receiver import receiver_of, solutions
from orthonav.onboard.gnss.biases import Biases, Difference, finding, unknown
from orthonav.onboard.gnss.monitor import MONITOR, GnssMonitor, GnssState, MapPosition, Receiver

S = 10**9
KNOWN = Biases(np.zeros(5), np.diag([1.5, 1.5, 0.01, 0.01, 0.1]) ** 2, 3600.0)


class Air:
    """A straight flight to the north at 20 m/s over a perfect map, one step a second."""

    def __init__(self, start=None, speed_mps=20.0, reference=None):
        self.monitor, self.now_s = GnssMonitor(FRAME, start, reference), 1000
        self.speed = speed_mps
        self.north_m, self.rng, self.states = 0.0, np.random.default_rng(0), []

    def fly(self, seconds, gnss_m=(0.0, 0.0), map_m=(0.0, 0.0), silent=False, **sample):
        """Fly with constant errors of GNSS and map; the states that were seen."""
        for _ in range(seconds):
            self.now_s += 1
            self.north_m += self.speed
            true = np.array([0.0, self.north_m])
            if not silent:
                self.monitor.sample(self._sample(true + gnss_m, sample))
            if map_m is not None:
                self.monitor.position(
                    MapPosition(
                        self.now_s * S + S // 2,
                        true + np.add(map_m, (0.0, self.speed / 2)) + self.rng.normal(0, 1, 2),
                        3.0,
                        np.array([0.0, self.speed]),
                    )
                )
            status = self.monitor.tick(self.now_s * S + S // 2)
            if not self.states or self.states[-1] != (status.state, status.fault):
                self.states.append((status.state, status.fault))
        return self.monitor.status

    def _sample(self, en_m, changed):
        lat, lon = FRAME.latlon_from_en(en_m + self.rng.normal(0, 0.3, 2))
        made = GnssSample(
            self.now_s * S, self.now_s * S, float(lat), float(lon), 3, 1.5, (0.0, self.speed)
        )
        return replace(made, **changed)


def test_agreement_is_reached_and_the_displacement_learnt():
    air = Air()
    errors = {"gnss_m": (12.0, -5.0), "map_m": (12.0 - 25.0, -5.0 + 10.0)}
    assert air.fly(30, **errors).state is GnssState.WAITING
    status = air.fly(600, **errors)
    assert (status.state, status.reason) == (GnssState.GOOD, None)
    learnt = air.monitor.learnt
    assert learnt.en_m == pytest.approx([25, -10], abs=2.5)
    assert learnt.std_m < 6 and learnt.agreed_s > 400
    assert status.difference_en_m == pytest.approx([25, -10], abs=2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "seconds", "names"),
    [
        ("step:metres=30", 5.0, {Fault.JUMP, Fault.STEP}),
        ("step:metres=30,over_s=3", 5.0, {Fault.STEP}),
        ("drag:mps=1", 60.0, {Fault.DRIFT}),
        ("drift:mps=1", 60.0, {Fault.DRIFT}),
        ("frozen", 5.0, {Fault.FROZEN}),
        ("frozen:stale=1", 5.0, {Fault.FROZEN}),
        ("jumping:metres=40", 5.0, {Fault.JUMP, Fault.STEP}),
        ("jam", 0.5, {Fault.LOST}),
        ("jam:silent=1", MONITOR.silence_s + 1.5, {Fault.LOST}),
    ],
)
def test_a_fault_is_named_in_time(text, seconds, names):
    """Delays of the requirement; positions of the map come once a second."""
    first_s, last_s, name = delay(text, 10, MAPS["usual"], at_s=100.0, for_s=seconds + 15)
    assert 0 <= first_s <= last_s and first_s <= seconds
    assert name in names


@pytest.mark.parametrize(
    ("name", "seed", "hours"),
    [
        ("usual", 11, 0.2),
        pytest.param("usual", 11, 10 / 3, marks=pytest.mark.slow),
        pytest.param("poor", 12, 10 / 3, marks=pytest.mark.slow),
        pytest.param("high", 13, 10 / 3, marks=pytest.mark.slow),
    ],
)
def test_hours_without_a_fault_raise_no_alarm(name, seed, hours):
    """Ten hours in the slow tests: multipath, latency, turns, gaps, single wrong map positions."""
    errors = MAPS[name]
    alarms, last = false_alarms(hours, seed, "good:std_m=4", errors, rate_hz=1.0)
    assert alarms == []
    assert last.status.state is GnssState.GOOD
    off_m = np.hypot(*(last.learnt.en_m - errors.displaced_en_m))
    assert off_m < 4 * last.learnt.std_m < 15


def test_a_slow_drag_off_never_becomes_a_displacement():
    """A drag-off of 0.2 m/s is named before it was learnt by as much as it moved."""
    air = Air(KNOWN)
    air.fly(120)
    for second in range(400):
        status = air.fly(1, gnss_m=(0.2 * second, 0.0))
    assert status.state is GnssState.ALARM and status.fault in (Fault.OFFSET, Fault.DRIFT)
    assert np.hypot(*air.monitor.learnt.en_m) < 2


def test_a_drag_off_that_was_learnt_is_named_and_undone():
    air = Air(KNOWN)
    air.fly(120)
    poisoned = air.monitor.learnt.mean + np.array([25.0, 0, 0, 0, 0])
    air.monitor._learner.begin(replace(air.monitor.learnt, mean=poisoned))
    status = air.fly(3)
    assert (status.state, status.fault) == (GnssState.ALARM, Fault.OFFSET)
    assert status.fault_en_m == pytest.approx([25, 0], abs=1)
    assert np.array_equal(air.monitor.learnt.mean, KNOWN.mean)
    assert air.fly(90).state is GnssState.GOOD  # it agrees with what was known before


@pytest.mark.long
def test_a_latency_does_not_make_a_step_where_the_aircraft_rolls():
    """Turns at 25 m/s and 300 m with images 0.3 s late displace views by 20 m for seconds."""
    errors = replace(MAPS["usual"], late_s=0.3, gaps_per_hour=0.0, outlier_share=0.0)
    rng = np.random.default_rng(2)
    path = lawnmower(700, (25.0,))
    positions = map_positions(path, errors, rng)
    solved = solutions(receiver_of("good"), path.times_s, path.en_m, rng, 1.0)
    monitor = GnssMonitor(FRAME)
    states = {status.state for _, status in fed(monitor, solved, positions)}
    assert states == {GnssState.WAITING, GnssState.GOOD}
    rolled = path.bank_tangent(0.0) - path.bank_tangent(0.3)
    assert 300 * np.abs(rolled).max() > 15  # the flight has such rolls


def test_a_spoofed_place_at_the_start_is_an_offset():
    air = Air()
    status = air.fly(30, gnss_m=(400.0, 0.0))
    assert (status.state, status.fault) == (GnssState.ALARM, Fault.OFFSET)
    air = Air(KNOWN)  # with a known displacement much less is enough
    status = air.fly(90, gnss_m=(60.0, 0.0))
    assert (status.state, status.fault) == (GnssState.ALARM, Fault.OFFSET)


def test_a_constant_offset_from_the_start_counts_as_displacement_of_an_unknown_map():
    """What cannot be known is documented: nothing tells this spoofing from a displaced map."""
    air = Air()
    air.fly(450, gnss_m=(60.0, 0.0))
    assert air.monitor.learnt.en_m == pytest.approx([60, 0], abs=4)
    assert not air.monitor.learnt.is_plausible  # but it is named


@pytest.mark.long
def test_a_return_is_announced_after_agreement_only():
    air = Air()
    air.fly(400)
    assert air.fly(20, gnss_m=(35.0, 0.0)).state is GnssState.ALARM
    assert air.fly(300, gnss_m=(35.0, 0.0)).state is GnssState.ALARM  # it does not heal by itself
    status = air.fly(30)
    assert (status.state, status.reason) == (GnssState.RETURNING, "gnss_returning")
    status = air.fly(int(MONITOR.return_s) + 10)
    assert (status.state, status.fault) == (GnssState.GOOD, None)
    assert np.hypot(*status.difference_en_m) < 3


@pytest.mark.long
def test_an_outage_needs_agreement_too():
    air = Air()
    air.fly(400)
    assert air.fly(5, fix_type=1).fault is Fault.LOST
    assert air.fly(8).state is GnssState.ALARM
    assert air.fly(8).state is GnssState.RETURNING
    assert air.fly(int(MONITOR.return_s) + 10).state is GnssState.GOOD
    air.fly(5, fix_type=1)
    assert air.fly(30, gnss_m=(50.0, 0.0)).reason == "gnss_offset"  # it came back elsewhere


def test_a_drag_off_that_was_learnt_before_a_restart_is_found():
    dragged = replace(KNOWN, mean=np.array([30.0, 0, 0, 0, 0]))
    assert Air(dragged).fly(30, gnss_m=(30.0, 0.0)).fault is None
    air = Air(dragged, reference=KNOWN)
    assert air.fly(30, gnss_m=(30.0, 0.0)).fault is Fault.OFFSET
    assert air.monitor.learnt is air.monitor.reference is KNOWN


def test_a_jump_of_the_map_is_not_blamed_on_gnss():
    air = Air()
    air.fly(400)
    status = air.fly(20, map_m=(60.0, 0.0))
    assert status.state is GnssState.ALARM and status.fault is Fault.DISAGREES


def test_single_wrong_positions_of_the_map_are_ignored():
    air = Air()
    for _ in range(20):
        air.fly(20)
        air.fly(1, map_m=(120.0, 0.0))
    assert all(state is not GnssState.ALARM for state, _ in air.states)


HERE = {"lat_deg": FRAME.lat_deg, "lon_deg": FRAME.lon_deg}
NO_MAP, NO_VELOCITY = {"map_m": None}, {"vel_en_mps": None}


@pytest.mark.parametrize(
    ("usual", "seconds", "change", "fault"),
    [
        (NO_MAP, 1, {"gnss_m": (40.0, 0.0)}, Fault.JUMP),
        (NO_MAP | NO_VELOCITY, 1, {"gnss_m": (50.0, 0.0)}, Fault.JUMP),
        ({}, 1, {"std_m": 80.0}, Fault.LOST),
        ({}, 1, {"std_m": math.nan}, None),
        *(({}, 1, wrong, Fault.LOST) for wrong in ({"lat_deg": math.nan}, {"lat_deg": 214.7})),
        ({}, 1, {"lon_deg": 1e9}, Fault.LOST),
        ({}, 6, HERE | NO_VELOCITY, Fault.FROZEN),
        ({}, 29, {"vel_en_mps": (3.0, 20.0)}, Fault.VELOCITY),
    ],
)
def test_the_receiver_is_checked_by_itself(usual, seconds, change, fault):
    air = Air()
    assert air.fly(60, **usual).state is GnssState.WAITING
    if fault is Fault.VELOCITY:
        air.fly(1, **NO_VELOCITY)  # one that is missing delays it only
    status = air.fly(seconds, **usual | change)
    assert status.fault is fault


def test_a_hovering_receiver_may_repeat_its_position():
    air = Air(speed_mps=0.0)
    air.fly(60)
    air.fly(20, **HERE)
    assert all(state is not GnssState.ALARM for state, _ in air.states)


def test_a_receiver_without_velocity_is_watched():
    air = Air()
    assert air.fly(200, **NO_VELOCITY).state is GnssState.GOOD
    assert air.fly(6, **NO_VELOCITY, gnss_m=(50.0, 0.0)).state is GnssState.ALARM


def test_a_slide_past_missing_velocities_is_a_jump():
    """A cross-track slide of 10 m/s at 5 Hz; every tenth velocity is missing."""
    receiver, faults = Receiver(), []
    for count in range(75):
        ns = count * S // 5
        en_m = np.array([10.0 * max(0.0, ns / S - 10), 20.0 * ns / S])
        lat, lon = (float(each) for each in FRAME.latlon_from_en(en_m))
        velocity = None if count % 10 == 0 else (0.0, 20.0)
        assert receiver.add(GnssSample(ns, ns, lat, lon, 3, 1.5, velocity), en_m)
        faults.append(receiver.fault(ns, 20.0))
    assert set(faults[:51]) == {None}  # before the slide
    assert Fault.JUMP in faults[51:66] and Fault.JUMP in faults[66:]


def test_a_receiver_that_was_never_heard_has_no_fault():
    assert Receiver().fault(10**12, 20.0) is None
    assert Air().fly(100, silent=True).state is GnssState.WAITING


def test_a_clock_that_goes_back_begins_a_new_window():
    air = Air()
    air.fly(200)
    air.now_s -= 150
    air.fly(100)
    assert all(state is not GnssState.ALARM for state, _ in air.states)


def value(second, en_m, std_m=3.0):
    return Difference(float(second), np.array(en_m), 2.0, std_m, 0.0, np.array([0.0, 20.0]))


@pytest.mark.parametrize("bearing", [0.0, 77.0, 200.0])
def test_size_and_direction_of_a_step_are_estimated(bearing):
    angle = math.radians(bearing)
    step = 40 * np.array([math.sin(angle), math.cos(angle)])
    values = [value(second, step if second >= 35 else (0.0, 0.0)) for second in range(40)]
    found = finding(values, unknown())
    assert found.fault is Fault.STEP and found.en_m == pytest.approx(step, abs=2)
    assert found.onset_s == pytest.approx(35, abs=2)
