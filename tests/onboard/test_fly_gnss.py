"""`orthonav fly --gnss`: solutions of an autopilot are compared, faults are reported."""

import math
from argparse import Namespace
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from fake_autopilot import AHEAD_NS, MS, FakeLocator, S, fix
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from test_fly import Flight, beginning

from orthonav.cli.flying import _interrupted
from orthonav.core.flight.gnss import FAULTS, GnssSample
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import ViewResult
from orthonav.onboard.gnss.biases import unknown
from orthonav.onboard.gnss.watch import GnssWatch
from orthonav.onboard.state import SavedState, learnt_biases, reference_biases, save
from orthonav.onboard.telemetry import Clocks

FRAME = LocalFrame(48.0, 2.0)
SPEED_MPS = 10.0


class Watched(Flight):
    """A flight to the north at 10 m/s, whose autopilot sends GPS_RAW_INT; `off_m` is its error."""

    def __init__(self, tmp_path, receiver="gps_raw_int", **options):
        known = options.pop("known", {})
        self.off_m, self.fix_type, self.receiver, self.north_m = np.zeros(2), 3, receiver, 0.0
        solved = deque()
        self.watch = GnssWatch(FRAME, solved, digest="d", known=known)
        locator = FakeLocator(lambda view: self.seen())
        super().__init__(tmp_path, locator, gnss=self.watch, **options)
        self.link.gnss = solved
        self.frames, write = [], self.port.write
        self.port.write = lambda data: (self.frames.append(bytes(data)), write(data))

    def seen(self):
        lat, lon = FRAME.latlon_from_en([0.0, self.north_at(self.time.now_ns - 50 * MS)])
        return fix(float(lat), float(lon), std_m=3.0)

    def sent(self, kind):
        """Messages of a kind since the last call, decoded by pymavlink."""
        decoder = mavlink.MAVLink(None)
        messages = [each for frame in self.frames for each in decoder.parse_buffer(frame)]
        self.frames.clear()
        return [each for each in messages if each.get_type() == kind]

    @staticmethod
    def north_at(time_ns):
        return SPEED_MPS * (time_ns / S - 100)

    def talk(self):
        super().talk()
        now = self.time.now_ns
        lat, lon = FRAME.latlon_from_en(np.add(self.off_m, [0.0, self.north_at(now)]))
        values = {"lat": round(float(lat) * 1e7), "lon": round(float(lon) * 1e7), "alt": 0}
        more = {"dgps_numch": 0, "dgps_age": 0} if self.receiver == "gps2_raw" else {}
        self.hear(
            self.autopilot.say(
                self.receiver,
                time_usec=(now + AHEAD_NS) // 1000,
                fix_type=self.fix_type,
                eph=100,
                epv=65535,
                vel=round(SPEED_MPS * 100),
                cog=0,
                satellites_visible=14,
                h_acc=1500,
                **values,
                **more,
            )
        )


@pytest.fixture
def begin(tmp_path):
    yield from beginning(Watched, tmp_path)


@pytest.mark.long
def test_agreement_is_no_reason(begin):
    flight = begin()
    flight.views(160, wait_s=0.5)
    north_m = flight.north_at(flight.time.now_ns - 50 * MS)
    health = flight.health()
    assert not [reason for reason in health.reasons if reason.startswith("gnss")]
    line = [each for each in flight.written() if "health" in each][-1]
    (status,) = line["gnss"]
    assert status["state"] == "good" and status["difference_m"] < 2
    last = [each for each in flight.written() if "frame" in each][-1]["evidence"]
    place = FRAME.en_from_latlon(last["gnss_lat_deg"], last["gnss_lon_deg"])
    assert place == pytest.approx([0, north_m], abs=0.5)
    assert last["gnss_fault"] == 0 and last["gnss_std_m"] == 1.5


@pytest.mark.long
@pytest.mark.parametrize("receiver", ["gps_raw_int", "gps2_raw"])
def test_a_step_is_reported_everywhere(begin, receiver):
    flight = begin(receiver=receiver)
    flight.views(90, wait_s=0.5)
    flight.frames.clear()
    flight.off_m = np.array([40.0, 0.0])
    flight.views(30)
    assert flight.reasons() & {"gnss_jump", "gnss_step"}
    name = "GNSS" if receiver == "gps_raw_int" else "GNSS 2"
    alarms = [each.text for each in flight.sent("STATUSTEXT") if each.severity == 2]
    assert alarms and alarms[0].startswith(f"orthonav {name} jump")
    flight.views(20, wait_s=0.5)
    assert flight.reasons() >= {"gnss_step"}
    evidence = [each for each in flight.written() if "frame" in each][-1]["evidence"]
    assert evidence["gnss_fault"] == FAULTS.index("gnss_step") + 1
    assert flight.log.named("health")[-1][0]["gnss"][0]["fault"] == "gnss_step"


def test_named_values_are_sent_once_a_second(begin):
    flight = begin()
    flight.views(100)
    flight.frames.clear()
    flight.fix_type = 1
    flight.views(20)
    sent = flight.sent("NAMED_VALUE_FLOAT")
    assert {each.name for each in sent} == {"gnss_fault", "gnss_diff"} and len(sent) == 4
    assert [each.value for each in sent if each.name == "gnss_fault"][-1] == FAULTS.index(
        "gnss_lost"
    ) + 1
    assert "gnss_lost" in flight.reasons()


@pytest.mark.long
def test_what_was_learnt_is_reported_and_saved_by_the_digest_of_the_map(
    begin, tmp_path, monkeypatch
):
    monkeypatch.setattr("orthonav.onboard.gnss.biases.QUARANTINE_S", 20.0)
    state = tmp_path / "state.json"
    save(state, SavedState(), {"other": unknown("x").to_plain()})
    flight = begin(known=learnt_biases(state), state_path=state)
    flight.off_m = np.array([30.0, 0.0])
    flight.views(230, wait_s=0.5)
    flight.health()
    found = learnt_biases(state)
    assert found["other"].setup == "x" and list(found)[-1] == "d"
    assert found["d"].en_m == pytest.approx([30, 0], abs=2) and found["d"].agreed_s > 60
    (status,) = [each for each in flight.written() if "health" in each][-1]["gnss"]
    assert status["agreed_s"] > 60
    evidence = [each for each in flight.written() if "frame" in each][-1]["evidence"]
    assert evidence["gnss_map_east_m"] == pytest.approx(30, abs=2)
    assert 1 < evidence["gnss_map_east_std_m"] < 7
    assert evidence["gnss_mount_pitch_std_deg"] > 1 and evidence["gnss_latency_std_ms"] > 100
    assert "map_displaced" in flight.reasons()  # by more than maps usually are


@pytest.mark.parametrize("age_s, east_m", [(299, 0.0), (301, 14.0)])
def test_the_reference_survives_a_restart_in_flight(tmp_path, age_s, east_m):
    """What a flight learnt, perhaps a drag-off, is the reference of the next flight only."""
    path, before = tmp_path / "state.json", replace(unknown(), agreed_s=7200.0)
    dragged = replace(before, mean=np.array([14.0, 0, 0, 0, 0]))
    saved = {**dragged.to_plain(), "reference": before.to_plain()}
    save(path, SavedState(48.0, 2.0, 5.0, utc_ns=1000 * S), {"d": saved})
    clocks = Clocks(utc_ns=lambda: (1000 + age_s) * S)
    for _ in range(2):
        solutions = deque()
        watch = GnssWatch(
            FRAME,
            solutions,
            digest="d",
            known=learnt_biases(path),
            reference=_interrupted(Namespace(state=path), "d", clocks),
        )
        made = watch.maps()
        solutions.append(GnssSample(S, S, 48.0, 2.0, 3))
        watch.tick(S)
        assert watch.plain() and watch.maps() == made
        assert made["d"]["mean"][0] == 14 and made["d"]["reference"]["mean"][0] == east_m
        save(path, SavedState(48.0, 2.0, 5.0, utc_ns=1000 * S), made)


def test_a_state_file_without_a_reference_is_used(tmp_path):
    path = tmp_path / "state.json"
    save(path, SavedState(), {"d": unknown().to_plain(), "odd": {"reference": 3}})
    assert list(learnt_biases(path)) == ["d"]
    assert [reference_biases(path, each) for each in ("d", "odd", "other")] == [None] * 3


def test_neither_heading_nor_mount_is_learnt_from_a_position_without_heading(begin):
    flight = begin()
    flight.seen = lambda: replace(Watched.seen(flight), heading_deg=math.nan)
    flight.views(30)
    offs = [each.status.difference_en_m[0] for each in flight.watch._monitors.values()]
    assert offs and np.isnan(offs).all()


def test_solutions_of_another_clock_use_their_arrival(begin):
    flight = begin()
    flight.views(3)
    flight.link.gnss.clear()
    flight.hear(
        flight.autopilot.say(
            "gps_raw_int", 1_700_000_000 * 10**6, 3, 480000000, 20000000, 0, 65535, 65535, 65535,
            65535, 255,
        )
    )  # fmt: skip
    (sample,) = flight.link.gnss
    assert sample.time_ns == sample.arrived_ns == flight.time.now_ns
    assert sample.vel_en_mps is None and sample.satellites == -1 and math.isnan(sample.std_m)


def test_an_error_of_the_monitor_does_not_end_the_flight(begin, caplog):
    flight = begin()
    flight.views(10)
    flight.frames.clear()
    flight.watch._monitors[0].position = None  # any bug
    results = flight.views(10)
    flight.health()
    assert len(flight.sent("GLOBAL_POSITION_SENSOR")) == 10 and all(results)
    assert caplog.text.count("could not be compared with GNSS") == 1


def corrections(differences_m, std_m=3.6, fix_type=3, known=None):
    """Corrections (2,) of fixes and their standard deviations, at views of every second, after
    which GNSS is lost.

    `differences_m`: GNSS less map (2,)."""
    solutions, en_m = deque(), np.zeros(2)
    watch = GnssWatch(FRAME, solutions, digest="d", known=known or {})
    made = []
    for second, difference_m in enumerate([*differences_m, *[None] * 6]):
        time_ns = (100 + second) * S
        en_m = np.add(en_m, [0.0, SPEED_MPS])
        gnss_m = en_m + (np.zeros(2) if difference_m is None else np.asarray(difference_m))
        lat, lon = FRAME.latlon_from_en(gnss_m)
        kind = 1 if difference_m is None else fix_type
        velocity = (0.0, SPEED_MPS)
        solutions.append(GnssSample(time_ns, time_ns, float(lat), float(lon), kind, 1.0, velocity))
        lat, lon = FRAME.latlon_from_en(en_m)
        before = fix(float(lat), float(lon), std_m=std_m)
        result = ViewResult("", time_ns, before, 0.0, "tracking")
        after = watch.view(result, time_ns).outcome
        watch.tick(time_ns)
        made.append((FRAME.en_from_latlon(after.lat_deg, after.lon_deg) - en_m, after.std_m))
    return made


def corrected_by(*arguments, **named):
    """The last one."""
    return corrections(*arguments, **named)[-1]


def test_fixes_are_corrected_by_what_was_seen_before_gnss_failed():
    moved_m, std_m = corrected_by([(4.0, 0.0)] * 90, fix_type=4)
    assert 1.5 < moved_m[0] < 4 and abs(moved_m[1]) < 0.5 and std_m < 3.2
    less_m, wider_m = corrected_by([(4.0, 0.0)] * 90)  # a receiver without corrections
    assert 0.5 < less_m[0] < moved_m[0] and std_m < wider_m < 3.6


def test_nothing_is_corrected_without_gnss_nor_where_no_displacement_is_included():
    moved_m, std_m = corrected_by([])
    assert moved_m == pytest.approx([0, 0], abs=0.01) and std_m == pytest.approx(3.6)
    moved_m, std_m = corrected_by([(4.0, 0.0)] * 90, std_m=2.0)
    assert moved_m == pytest.approx([0, 0], abs=0.01) and std_m == pytest.approx(2.0)


@pytest.mark.parametrize(
    "differences_m",
    [
        [(40.0, 0.0)] * 200,
        [(0.0, 0.0)] * 60 + [(0.4 * second, 0.0) for second in range(60)],
        [(0.0, 0.0)] * 60 + [(0.1 * second, 0.0) for second in range(300)],
        [(0.0, 0.0)] * 60 + [(30.0, 0.0)] * 30,
    ],
    ids=["offset", "dragged", "dragged slowly", "step"],
)
def test_a_spoofed_receiver_moves_fixes_by_six_metres_and_within_their_protection_level(
    differences_m,
):
    """Fixes of 3.6 m without it: at a risk of 0.001 their level is 6.7 deviations."""
    for moved_m, std_m in corrections(differences_m, fix_type=4):
        assert np.hypot(*moved_m) <= min(6.001, 3.5 * std_m)


def test_the_displacement_of_an_earlier_flight_corrects_a_flight_without_gnss():
    learnt = replace(unknown(), mean=np.array([4.0, -2.0, 0, 0, 0]), agreed_s=3600.0)
    learnt = replace(learnt, cov=learnt.cov * np.diag([1e-3, 1e-3, 1, 1, 1]))
    moved_m, std_m = corrected_by([], known={"d": learnt})
    assert moved_m == pytest.approx([3.7, -1.8], abs=0.4) and std_m < 2.6


def test_a_watch_without_solutions_reports_nothing():
    watch = GnssWatch(FRAME, deque())
    assert watch.tick(10**12) == [] and watch.reasons() == () and watch.plain() == []
    assert watch.maps() == {} and math.isnan(watch.difference_m)
