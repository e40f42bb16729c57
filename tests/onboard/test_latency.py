"""Whole flights with a live camera whose images are late: nothing wrong is sent."""

import math

import numpy as np
import pytest
from benchmarks.fakes import BEGIN_NS, Stream
from fake_autopilot import MS, Autopilot, FakeLocator, Port, S, Time, fix
from flown import SMALL as CAMERA
from flown import Flown

from orthonav.onboard.cameras import LiveCamera, NewestImage
from orthonav.onboard.fly import FlyOptions, Runner
from orthonav.onboard.latency import LatencyMonitor
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.estimate import Clock
from orthonav.onboard.messages.gate import Gate, GateRules
from orthonav.onboard.outputs import MessageOptions, Messenger
from orthonav.onboard.publisher import Publisher
from orthonav.onboard.telemetry import TelemetryBuffer

METRES = 111_195.0  # a degree of latitude; the flights are at the equator
BEGIN_S = 10.0
AHEAD_NS = -90 * S
LARGEST_ERROR_M = 8.0


class LateStream(Stream):
    """A capture whose images arrive when the test says so, exposed at `exposed_s`."""

    def __init__(self, flight):
        super().__init__(lambda: self.change(flight.flown.picture(self.exposed_s, CAMERA)))
        self.exposed_s, self.stamp_s = 0.0, math.nan
        self.change = lambda grey: grey

    def get(self, _):
        return 0.0 if math.isnan(self.stamp_s) else self.stamp_s * 1e3


class LateFlight:
    """A flight of `orthonav fly` with a fake clock, whose locator is always right about where an
    image was exposed, but not when."""

    def __init__(self, flown, stated_s, delay_s, *, rate_hz=5.0, max_age_s=1.0, clock_rate=0.0):
        """`clock_rate`: how much faster the autopilot's clock runs than ours."""
        self.flown, self.delay_s, self.rate_hz = flown, delay_s, rate_hz
        self.clock_rate = clock_rate
        self.time, self.port, self.autopilot = Time(), Port(), Autopilot()
        clocks = self.time.clocks
        self.link = AutopilotLink(self.port.open, TelemetryBuffer(), clocks)
        self.gate = Gate(GateRules(max_age_s=max_age_s), Clock.BOOT)
        messages = MessageOptions(("global-position",))
        messenger = Messenger(messages, self.gate, self.link.send, clocks)
        publisher = Publisher(self.gate, clocks, messenger=messenger, link=self.link)
        self.stream = LateStream(self)
        self.source = LiveCamera(0, clocks, capture=lambda _: self.stream)
        self.newest, self.monitor = NewestImage(), LatencyMonitor(stated_s)
        self.runner = Runner(
            self.newest,
            CAMERA,
            FakeLocator(self.where),
            publisher,
            FlyOptions(),
            clocks,
            link=self.link,
            latency=self.monitor,
        )
        self.sent = []  # time since the start, error in metres, age
        self.results = []
        self.stamps, self.stalled = False, False
        self.requests = []  # of TIMESYNC, not yet answered
        self.hear(self.autopilot.heartbeat())

    @property
    def now_s(self):
        """Time of the generated flight, of which a late stream shows an earlier part."""
        return BEGIN_S + (self.time.now_ns - BEGIN_NS) / S

    def where(self, view):
        north, east = self.flown.at(self.stream.exposed_s)[2]
        heading, height = view.telemetry.yaw_deg, view.telemetry.agl_m
        return fix(north / METRES, east / METRES, std_m=2.0, heading_deg=heading, agl_m=height)

    def hear(self, *frames):
        self.port.coming.extend(frames)
        self.link.poll()

    def talk(self):
        """Telemetry of this moment, and answers to TIMESYNC."""
        ahead_ns = AHEAD_NS + round(self.clock_rate * (self.time.now_ns - BEGIN_NS))
        boot_ns = self.time.now_ns + ahead_ns
        (yaw, pitch, roll), (north, east), _ = self.flown.at(self.now_s)
        requests, self.requests = self.requests + self.port.sent("TIMESYNC"), []
        answers = self.autopilot.answers(requests, self.time.now_ns, ahead_ns)
        self.hear(
            self.autopilot.attitude(boot_ns, yaw, pitch, roll),
            self.autopilot.home(boot_ns, self.flown.agl_m),
            self.autopilot.local(boot_ns, (north, east, 0.0)),
            *answers,
        )

    def fly(self, seconds):
        """Fly on; the errors of the messages of this time."""
        end_ns, before = self.time.now_ns + round(seconds * S), len(self.sent)
        due_ns, step_ns = self.time.now_ns, round(S / self.rate_hz)
        while self.time.now_ns < end_ns:
            self.time.now_ns += 100 * MS
            self.talk()
            if self.time.now_ns >= due_ns and not self.stalled:
                due_ns += step_ns
                self.image()
            due_ns = max(due_ns, self.time.now_ns - step_ns)
        return self.sent[before:]

    def image(self):
        """One image arrives."""
        self.stream.exposed_s = self.now_s - self.delay_s(self.now_s)
        if self.stamps:
            self.stream.stamp_s = 1000 + self.stream.exposed_s
        self.requests += self.port.sent("TIMESYNC")
        self.newest.put(self.source.read())
        result = self.runner.step(0)
        self.results.append((self.now_s, result))
        for message in self.port.sent("GLOBAL_POSITION_SENSOR"):
            age_s = message["processing_time"] / 1e6
            north, east = self.flown.at(self.now_s - age_s)[2]
            off = message["lat"] * 1e-7 * METRES - north, message["lon"] * 1e-7 * METRES - east
            self.sent.append((self.now_s, float(np.hypot(*off)), age_s))

    def reasons(self):
        return set(self.runner.health.reasons)


def constant(delay_s):
    return lambda now_s: delay_s


def worst_m(sent):
    return max((error for _, error, _ in sent), default=0.0)


def test_an_undisturbed_flight_keeps_its_messages():
    flight = LateFlight(Flown(70, seed=1), 0.12, constant(0.12))
    flight.fly(5)
    assert flight.gate.withheld["latency_unknown"] < 4.5 * flight.rate_hz  # compared first
    before = len(flight.results)
    sent = flight.fly(12)
    assert len(sent) >= 0.98 * (len(flight.results) - before) and worst_m(sent) < 4.0
    assert flight.runner.health.reasons == ()
    plain = flight.monitor.plain()
    assert (plain["latency_ms"], plain["latency"]) == (120.0, "stated")


def test_an_autopilot_whose_clock_runs_slow():
    """As PX4's simulator in lockstep."""
    flight = LateFlight(Flown(70, seed=1), 0.12, constant(0.12), clock_rate=-0.022)
    flight.fly(20)
    before = len(flight.results)
    sent = flight.fly(15)
    assert len(sent) >= 0.98 * (len(flight.results) - before) and worst_m(sent) < 4.0
    assert flight.runner.health.reasons == ()
    assert flight.monitor.plain()["latency"] == "stated"


def test_a_straight_flight_with_a_stated_latency_is_undisturbed():
    straight = Flown(70, turns=False, turbulence_deg=0.05, seed=2)
    flight = LateFlight(straight, 0.12, constant(0.12))
    flight.fly(5.5)
    before = len(flight.results)
    assert len(flight.fly(10)) >= 0.98 * (len(flight.results) - before)


@pytest.mark.long
def test_without_a_stated_latency_nothing_is_sent_until_it_is_measured():
    flight = LateFlight(Flown(70, seed=1), None, constant(0.25))
    assert flight.fly(10) == []
    assert "latency_unknown" in flight.reasons()
    assert flight.gate.withheld["latency_unknown"] >= len(flight.results) - 1
    assert "--camera-latency-ms" in flight.monitor.plain()["latency"]
    sent = flight.fly(26)
    assert len(sent) > 42 and worst_m(sent) < 4.0
    plain = flight.monitor.plain()
    assert plain["latency_ms"] == pytest.approx(250, abs=80) and plain["latency"] == "measured"
    assert flight.reasons() == set()


def test_without_a_stated_latency_a_straight_flight_sends_nothing():
    straight = Flown(70, turns=False, turbulence_deg=0.05, seed=2)
    flight = LateFlight(straight, None, constant(0.12))
    assert flight.fly(15) == []


@pytest.mark.long
def test_a_stream_that_is_late_from_the_start():
    """The stated latency is compared with the first images before it is used; then it is
    measured, and positions are withheld as stale."""
    late_s = 8.0
    flight = LateFlight(Flown(90, seed=3), 0.12, constant(late_s))
    flight.fly(40)
    assert worst_m(flight.sent) < LARGEST_ERROR_M
    plain = flight.monitor.plain()
    assert plain["latency_ms"] == pytest.approx(late_s * 1e3, abs=80)
    assert flight.gate.withheld["stale"] > 31


@pytest.mark.long
@pytest.mark.parametrize(
    ("late_s", "stamps"), [(0.7, False), pytest.param(8.0, True, marks=pytest.mark.slow)]
)
def test_a_stall_after_which_the_stream_is_late(late_s, stamps):
    delay = {"s": 0.12}
    flight = LateFlight(Flown(110, seed=4), 0.12, lambda _: delay["s"])
    flight.stamps = stamps
    assert len(flight.fly(14)) > 50
    flight.stalled = True
    flight.fly(late_s - 0.12)
    flight.stalled, delay["s"] = False, late_s
    sent = flight.fly(1.5)
    assert sent == [] and flight.reasons() & {"latency_unknown", "latency_unsteady"}
    sent = flight.fly(18)
    assert worst_m(sent) < LARGEST_ERROR_M
    assert flight.monitor.plain()["latency_ms"] == pytest.approx(late_s * 1e3, abs=80)
    if late_s < 0.9:
        assert len(sent) > 30
    # The stream catches up: a burst, then live images.
    delay["s"] = 0.12
    sent = flight.fly(20)
    late = [each for each in sent if each[1] > LARGEST_ERROR_M]
    assert all(at - flight.now_s < -15 for at, _, _ in late)
    assert worst_m(sent[-50:]) < 4.0 and len(sent) > 50
    assert flight.monitor.plain()["latency"] == "stated"


@pytest.mark.long
def test_a_stall_with_timestamps_that_catches_up_needs_no_manoeuvre():
    straight = Flown(70, turns=False, turbulence_deg=0.05, seed=2)
    flight = LateFlight(straight, 0.12, constant(0.12))
    flight.stamps = True
    flight.fly(12)
    flight.stalled = True
    flight.fly(2.0)
    flight.stalled = False
    assert len(flight.fly(10)) >= 48


@pytest.mark.parametrize("gap_s", [0.7, 2.0])
def test_a_stated_latency_holds_through_a_gap_without_a_manoeuvre(gap_s):
    straight = Flown(70, turns=False, turbulence_deg=0.05, seed=2)
    flight = LateFlight(straight, 0.12, constant(0.12))
    flight.fly(8)
    flight.stalled = True
    flight.fly(gap_s)
    flight.stalled = False
    flight.fly(5.5)  # compared with the images again, as at the start
    assert len(flight.fly(10)) >= 48 and flight.monitor.plain()["latency"] == "stated"


def test_a_latency_that_grew_in_a_gap_is_noticed_without_a_manoeuvre():
    straight = Flown(70, turns=False, turbulence_deg=0.05, seed=2)
    delay = {"s": 0.12}
    flight = LateFlight(straight, 0.12, lambda _: delay["s"], max_age_s=9.0)
    flight.fly(12)
    flight.stalled = True
    flight.fly(3.0)
    flight.stalled, delay["s"] = False, 3.0
    assert worst_m(flight.fly(15)) < LARGEST_ERROR_M


def test_a_gap_without_a_stated_latency_needs_a_manoeuvre():
    flight = LateFlight(Flown(70, seed=1), None, constant(0.25))
    flight.fly(30)
    assert flight.monitor.plain()["latency"] == "measured"
    flight.stalled = True
    flight.fly(1.0)
    flight.stalled = False
    assert flight.fly(1) == [] and "latency_unsteady" in flight.reasons()
    assert "no image for 1" in flight.monitor.plain()["latency"]


@pytest.mark.slow
def test_a_drifting_latency_is_followed():
    flight = LateFlight(Flown(90, seed=5), 0.1, lambda now_s: 0.1 + 0.012 * now_s)
    flight.fly(20)
    sent = flight.fly(40)
    assert worst_m(sent) < LARGEST_ERROR_M and len(sent) > 62


@pytest.mark.parametrize(
    "change",
    [
        lambda grey: grey[:, ::-1].copy(),
        lambda grey: grey[::-1, ::-1].copy(),
    ],
)
def test_mirrored_and_rotated_images_give_no_latency(change):
    flight = LateFlight(Flown(70, seed=1), None, constant(0.12))
    flight.stream.change = change
    assert flight.fly(15) == []
    assert flight.reasons() & {"latency_unknown", "motion_mismatch"}


@pytest.mark.long
def test_a_camera_that_freezes_with_noise_is_noticed():
    flight = LateFlight(Flown(70, seed=1), 0.12, constant(0.12))
    flight.fly(8)
    rng, still = np.random.default_rng(0), flight.flown.picture(flight.now_s, CAMERA)
    flight.stream.change = lambda _: np.uint8(
        np.clip(still + rng.normal(0, 3, still.shape), 0, 255)
    )
    flight.fly(8)
    assert len(flight.fly(5)) == 0
    flight.stream.change = lambda grey: grey
    flight.fly(10)
    assert len(flight.fly(5)) >= 24


def test_the_covariance_includes_the_latency():
    flight = LateFlight(Flown(70, seed=1), 0.12, constant(0.12))
    flight.fly(6)
    cov = flight.results[-1][1].outcome.cov_en_m2
    (north, east) = flight.flown.at(flight.now_s - 0.12)[1]
    along = np.array([east, north]) / np.hypot(east, north)
    across = np.array([-along[1], along[0]])
    assert along @ cov @ along == pytest.approx(4 + (0.03 * np.hypot(east, north)) ** 2, rel=0.02)
    assert across @ cov @ across == pytest.approx(4.0, rel=0.02)
