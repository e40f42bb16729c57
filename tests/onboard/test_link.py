"""The link: messages in and out, and failures of the port."""

import contextlib
import math
import os
import pty
import socket

import pytest
from fake_autopilot import AHEAD_NS, MS, UTC_NS, Autopilot, Linked, S, Time

from helpers import wait_for
from orthonav.core.errors import VariantError
from orthonav.onboard.link import AutopilotLink, LinkThread
from orthonav.onboard.messages.mavlink import Autopilot as Kind
from orthonav.onboard.messages.mavlink import Origin, Signing, Target, dialect, signing_timestamp
from orthonav.onboard.ports import Descriptor, open_serial, transport_opener
from orthonav.onboard.telemetry import TelemetryBuffer
from wire import decode

KEY = bytes(range(32))


class Flying(Linked):
    @property
    def state(self):
        return self.link.state_at(self.time.now_ns)

    def telemetry(self, **options):
        return self.state.telemetry(0, **options)

    def hear_attitude(self, **angles):
        return self.hear(self.autopilot.attitude(self.boot_ns(), **angles))

    def say(self, name, *values):
        """Hear a message of the autopilot; how many were understood."""
        return self.hear(self.autopilot.say(name, *values))

    def position(self, amsl_m, home_m):
        """GLOBAL_POSITION_INT with these heights."""
        mm = round(amsl_m * 1000), round(home_m * 1000)
        self.say("global_position_int", self.boot_ns() // MS, 0, 0, *mm, 0, 0, 0, 0)

    def altitude(self, bottom_m=0, terrain_m=-1001.0, since_ns=0):
        """ALTITUDE with these heights above ground; `since_ns`: the epoch of its time."""
        us = (since_ns + self.boot_ns()) // 1000
        self.say("altitude", us, 0, 640.0, 0, 55.0, terrain_m, bottom_m)


@pytest.fixture
def flying():
    made = Flying()
    made.hear(made.autopilot.heartbeat())
    made.port.gone.clear()
    return made


def test_the_first_autopilot_heard_is_the_target():
    flying = Flying()
    station = Autopilot(255, 190).heartbeat(kind=8)
    gimbal = Autopilot(1, 154).heartbeat(kind=8)
    as_autopilot = Autopilot(1, 171).say("heartbeat", 26, 0, 0, 0, 4, 3)
    other = Autopilot(9).attitude(5 * S)
    assert flying.hear(station, gimbal, as_autopilot, other) == 0 and flying.link.target is None
    assert flying.hear(flying.autopilot.heartbeat(kind=3)) == 1
    assert (flying.link.target, flying.link.kind) == (Target(1, 1), Kind.ARDUPILOT)
    assert flying.hear(Autopilot(9).heartbeat(), other, Autopilot(1, 2).attitude(5 * S)) == 0
    assert flying.link.buffer.covered_ns is None


def test_the_system_id_can_be_chosen():
    flying = Flying(system_id=7)
    assert flying.hear(Autopilot(1).heartbeat(), Autopilot(7).heartbeat()) == 1
    assert flying.link.target == Target(7, 1)
    flying.time.go(1.5)
    flying.link.poll()
    assert {each["from"] for each in flying.port.sent()[1:]} == {(7, 197)}


def test_telemetry_at_an_exposure(flying):
    for _ in range(3):
        now = flying.boot_ns()
        flying.hear(
            flying.autopilot.attitude(now, yaw_deg=30.0 + now / S, pitch_deg=2.0),
            flying.autopilot.home(now, 80.0),
            flying.autopilot.local(now, (9.0, 3.0, 0.5), down=-70.0),
        )
        flying.time.go(0.1)
    exposed = flying.time.now_ns - 250 * MS  # between the first and the second
    vehicle = flying.link.state_at(exposed)
    assert vehicle.telemetry(1).yaw_deg == pytest.approx(30.0 + (exposed + AHEAD_NS) / S, abs=1e-3)
    assert vehicle.height_m == pytest.approx(80.0)
    assert vehicle.telemetry(1).vel_en_mps == pytest.approx((3.0, 9.0))
    assert vehicle.down_m == pytest.approx(-70.0)
    assert exposed <= flying.link.covered_ns < flying.time.now_ns + S


def test_heights_above_sea_level(flying):
    flying.hear_attitude()
    flying.position(0.0, 60.0)
    state = flying.state
    assert state.home_m == state.height_m == 60.0 and math.isnan(state.amsl_m)  # 0 is "unknown"
    flying.altitude()
    assert flying.state.amsl_m == 640.0
    flying.time.go(0.02)
    flying.position(655.0, 60.0)
    assert flying.state.amsl_m == 655.0


PX4, ARDUPILOT = 12, 3


@pytest.mark.parametrize(
    ("kind", "amsl_m", "home_m", "known"),
    [
        *((kind, 160.0, 120.0, (120.0, 160.0)) for kind in (PX4, ARDUPILOT)),
        (PX4, 39.971, 39.971, (math.nan, 39.971)),  # no home position: both are above the sea
        (ARDUPILOT, -0.14, -0.14, (-0.14, math.nan)),  # no altitude by GNSS: above the start
        (ARDUPILOT, 120.0, 119.99, (119.99, math.nan)),
    ],
)
def test_one_height_that_is_sent_twice_is_not_taken_for_two(kind, amsl_m, home_m, known):
    flying = Flying()
    flying.hear(flying.autopilot.heartbeat(kind))
    flying.hear_attitude()
    flying.position(amsl_m, home_m)
    assert (flying.state.home_m, flying.state.amsl_m) == pytest.approx(known, nan_ok=True)


def test_heights_of_every_message(flying):
    flying.hear_attitude(roll_deg=10.0)
    down, autopilot = math.cos(math.radians(10)), flying.autopilot

    def height():
        return round(flying.state.height_m, 2)

    flying.altitude()
    assert height() == 55.0
    flying.hear(autopilot.home(flying.boot_ns(), 60.0))
    assert height() == 60.0
    flying.time.go(0.02)
    flying.altitude(terrain_m=42.0, since_ns=UTC_NS)  # stamped since 1970, as some do
    assert height() == 42.0
    flying.say("rangefinder", 50.0, 1.0)
    assert height() == round(50 * down, 2)
    flying.time.go(2.0)
    flying.hear_attitude(roll_deg=10.0)
    flying.altitude(terrain_m=42.0)
    assert height() == 42.0
    ms = flying.boot_ns() // MS
    flying.hear(autopilot.distance(flying.boot_ns(), 7.0, orientation=0))  # ahead
    flying.say("distance_sensor", ms, 20, 5000, 5000, 0, 0, 25, 255)  # too far
    flying.say("distance_sensor", ms, 20, 5000, 700, 0, 0, 25, 255, 0, 0, [0] * 4, 1)  # invalid
    flying.say("rangefinder", 50.0, 1.0)  # without the limits of the sensor that is out of them
    assert height() == 42.0
    flying.time.go(0.02)
    flying.hear(autopilot.distance(flying.boot_ns(), 40.0))
    assert height() == round(40 * down, 2)


def test_a_barometer_and_the_terrain_of_px4_are_no_heights(flying):
    """The terrain is 150 m above the origin of the local frame, and the aircraft 80 m above it."""
    flying.hear_attitude()
    flying.say("altitude", flying.boot_ns() // 1000, 489.8, 489.8, 0, 55.0, 150.0, 80.0)
    state = flying.state
    assert math.isnan(state.amsl_m) and state.height_m == 80.0


def test_attitude_as_a_quaternion(flying):
    half = math.radians(45.0)
    values = math.cos(half), 0, 0, math.sin(half), 0, 0, 0
    flying.say("attitude_quaternion", flying.boot_ns() // MS, *values)
    assert flying.telemetry().yaw_deg == pytest.approx(90.0, abs=1e-3)
    assert flying.telemetry(mount_deg=(90.0, 0.0, 0.0)).yaw_deg == pytest.approx(180.0, abs=1e-3)


def test_damaged_bytes_are_counted_and_skipped(flying):
    good = flying.autopilot.attitude(flying.boot_ns(), yaw_deg=12.0)
    broken = bytearray(flying.autopilot.attitude(flying.boot_ns(), yaw_deg=99.0))
    broken[14] ^= 0x55
    nan = flying.autopilot.attitude(flying.boot_ns(), yaw_deg=math.nan)
    noise = bytes([0xFD, 250, 0, 0, 1]) + os.urandom(3)
    flying.hear(bytes(broken), nan, good[:9])
    flying.hear(good[9:], noise, good * 20)
    assert flying.telemetry().yaw_deg == pytest.approx(12.0, abs=1e-3)
    assert flying.link.counts["damaged"] > 0


def test_a_time_far_ahead_hides_nothing(flying):
    """One damaged message: later ones would count as out of order until that time."""
    flying.hear_attitude(yaw_deg=10.0)
    ahead_ms = flying.boot_ns() // MS + 2_000_000
    flying.hear(flying.autopilot.attitude(ahead_ms * MS))
    flying.say("attitude_quaternion", ahead_ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    flying.say("global_position_int", ahead_ms, 0, 0, 640_000, 55_000, 0, 0, 0, 0)
    flying.say("local_position_ned", ahead_ms, 0.0, 0.0, -9.0, 1.0, 2.0, 0.0)
    flying.say("distance_sensor", ahead_ms, 10, 9000, 777, 0, 0, 25, 0)
    assert flying.link.sync.jumps == 0
    flying.time.go(0.05)
    flying.hear_attitude(yaw_deg=12.0)
    flying.position(500.0, 50.0)
    telemetry = flying.telemetry()
    assert (telemetry.yaw_deg, telemetry.agl_m) == (pytest.approx(12.0, abs=1e-3), 50.0)
    assert telemetry.vel_en_mps is None and flying.link.covered_ns <= flying.time.now_ns + 30 * MS


def test_heartbeat_and_timesync_once_a_second(flying):
    for _ in range(100):
        flying.time.go(0.05)
        flying.link.poll()
    said = flying.port.sent()
    names = [each["name"] for each in said]
    assert names.count("HEARTBEAT") == 5 and names.count("TIMESYNC") in (5, 6)
    beat = said[names.index("HEARTBEAT")]
    assert (beat["type"], beat["autopilot"], beat["from"]) == (18, 8, (1, 197))


def test_clocks_are_compared(flying):
    for _ in range(5):
        flying.time.go(1.0)
        flying.link.poll()
        asked = flying.port.sent("TIMESYNC")[-1]
        assert asked["tc1"] == 0
        flying.time.go(0.004)
        there = flying.boot_ns()
        flying.time.go(0.004)
        flying.say("timesync", there, asked["ts1"])
    assert flying.link.sync.is_exact
    for _ in range(2):
        assert flying.link.boot_ns(flying.time.now_ns) == pytest.approx(flying.boot_ns(), abs=MS)
        flying.say("timesync", 1, 12345)  # an answer without a request


def test_timesync_is_answered_by_the_clock_of_the_stamps(flying):
    """PX4 converts the stamps of ODOMETRY by the offset that TIMESYNC gives it."""
    flying.say("timesync", 0, 776)
    answer = next(each for each in flying.port.sent("TIMESYNC") if each["tc1"])
    assert (answer["tc1"], answer["ts1"]) == (flying.time.clocks.utc_ns(), 776)


def test_a_missing_port_is_retried_at_growing_intervals():
    flying = Flying()
    flying.port.refuse = True
    for _ in range(600):
        flying.link.poll()
        flying.time.go(0.1)
    assert 12 <= flying.link.counts["error"] <= 18 and not flying.link.is_open
    assert flying.link.heard_age_s == math.inf
    flying.port.refuse = False
    flying.time.go(5.0)
    assert flying.hear(flying.autopilot.heartbeat()) == 1


def test_a_dry_run_sends_nothing():
    flying = Flying(silent=True)
    flying.hear(flying.autopilot.heartbeat(), flying.autopilot.say("timesync", 0, 7))
    flying.time.go(5.0)
    flying.link.poll()
    assert flying.port.gone == [] and flying.link.target == Target(1, 1)


def test_a_signed_link_ignores_unsigned_messages():
    stamp = signing_timestamp(UTC_NS + 100 * S)
    flying = Flying(signing=Signing(KEY, stamp))
    assert flying.hear(Autopilot().heartbeat(), Autopilot(key=bytes(32)).heartbeat()) == 0
    assert flying.link.target is None
    signed = Autopilot(key=KEY)
    frame = signed.heartbeat()
    assert flying.hear(frame) == 1
    assert flying.hear(frame) == 0  # said again by somebody who listened
    flying.link._incoming.parse_buffer = None  # an error of the decoder
    assert flying.hear(b"?") == 0
    assert flying.hear(frame) == 0 and flying.hear(signed.heartbeat()) == 1


def test_timestamps_of_signatures_always_increase():
    stamp = signing_timestamp(UTC_NS + 100 * S)
    flying = Flying(signing=Signing(KEY, stamp))
    flying.hear(Autopilot(key=KEY).heartbeat())
    flying.port.gone.clear()
    for second in range(35):
        if second == 30:
            assert flying.link.signing_now() - stamp > 20 * 100_000  # keeps up with the time
            flying.time.utc_ahead_ns -= 3600 * S  # set back
        flying.time.go(1.0)
        flying.link.poll()  # two messages at a time
    frames = flying.port.gone
    assert len(frames) == 70 and all(decode(each)["signed"] == 1 for each in frames)
    stamps = [int.from_bytes(each[-12:-6], "little") for each in frames]
    assert stamps == sorted(set(stamps)) and stamps[0] > stamp
    assert flying.link.signing_now() > stamps[-1]


def test_the_origin_of_the_autopilot_is_stored_until_it_restarts(flying):
    flying.say("gps_global_origin", 481000000, 20000000, 120_000)
    flying.say("gps_global_origin", 2**31 - 1, 20000000, 120_000)
    assert flying.link.counts["damaged"] == 1
    flying.hear_attitude()
    assert flying.link.origin == Origin(48.1, 2.0, 120.0)
    for number in range(40):
        flying.time.go(0.05)
        flying.hear(flying.autopilot.attitude((number + 1) * 50 * MS))
    assert flying.link.sync.jumps == 1 and flying.link.origin is None


ABSOLUTE, DEAD_RECKONING = 831, 303
GNSS_AIDED, UNAIDED = (1.0, 1.0), (5.0, 3.0)


class Reporting(Flying):
    """An autopilot that reports its filter and its receivers."""

    def __init__(self, **options):
        super().__init__(**options)
        self.hear(self.autopilot.heartbeat())
        self.hear_attitude()

    def stds(self):
        telemetry = self.telemetry()
        total_deg, mount_deg = telemetry.tilt_std_deg, telemetry.mount_std_deg
        assert total_deg == math.hypot(telemetry.horizon_std_deg, mount_deg) and mount_deg == 2.5
        return telemetry.vel_std_mps, pytest.approx(telemetry.horizon_std_deg)

    def report(self, flags=ABSOLUTE, receivers=(3,), vel_std_mps=None, ardupilot=False):
        us = self.boot_ns() // 1000
        if ardupilot:
            self.say("ekf_status_report", flags, *[0] * 5)
        elif flags is not None:
            self.say("estimator_status", us, flags, *[0] * 8)
        for number, fix_type in enumerate(receivers):
            name, more = (("gps_raw_int", ()), ("gps2_raw", (0, 0)))[number]
            self.say(name, us, fix_type, *[0] * 7, 9, *more)
        if vel_std_mps is not None:
            covariance = [0.0] * 21
            covariance[0], covariance[6] = vel_std_mps**2, 0.01
            place = us, 1, 12, 0, 0, 0, (1.0, 0, 0, 0), 0, 0, 0, 0, 0, 0
            self.say("odometry", *place, [0.0] * 21, covariance, 0, 8, 0)
        return self.stds()


@pytest.mark.parametrize("ardupilot", [False, True])
def test_velocity_and_horizon_are_accurate_only_while_gnss_holds_the_filter(ardupilot):
    flying, unaided = Reporting(), (5.0, 1.0) if ardupilot else UNAIDED  # its horizon holds
    assert flying.stds() == UNAIDED  # nothing is known
    assert flying.report(ardupilot=ardupilot) == GNSS_AIDED
    assert flying.report(DEAD_RECKONING, ardupilot=ardupilot) == unaided
    assert flying.report(ABSOLUTE | 1024, ardupilot=ardupilot) == unaided  # glitch, uninitialized
    assert flying.report(ABSOLUTE | 128, ardupilot=ardupilot) == unaided  # constant position
    assert flying.report(ardupilot=ardupilot) == GNSS_AIDED


def test_without_a_fix_of_a_receiver_the_filter_may_rest_on_orthonav():
    flying = Reporting()
    assert flying.report(receivers=()) == UNAIDED
    assert flying.report(receivers=(1,)) == UNAIDED
    assert flying.report(receivers=(1, 3)) == GNSS_AIDED
    flying.time.go(4.0)
    assert flying.report(receivers=()) == UNAIDED  # the receiver fell silent
    ours = Reporting(own_receiver=0)  # what it reports as its first receiver is GPS_INPUT
    assert ours.report(receivers=(3,)) == UNAIDED
    assert ours.report(receivers=(3, 3)) == GNSS_AIDED
    # Compared with the map it would always agree, and teach that the map is not displaced.
    assert {each.receiver for each in ours.link.gnss} == {1}


def test_a_fix_without_the_state_of_the_filter_is_not_enough():
    flying = Reporting()
    assert flying.report(flags=None) == UNAIDED
    flying.report()
    flying.time.go(6.0)
    assert flying.report(flags=None) == UNAIDED


def test_a_large_covariance_of_the_velocity_is_taken_over():
    flying = Reporting()
    assert flying.report(vel_std_mps=0.3) == GNSS_AIDED
    assert flying.report(vel_std_mps=2.0) == UNAIDED  # GNSS is received, but not fused
    assert flying.report(vel_std_mps=7.0) == (pytest.approx(7.0), 3.0)
    assert flying.report(vel_std_mps=math.nan) == GNSS_AIDED


@pytest.mark.parametrize(
    "url",
    [
        *("", "udpin:", "udpin:x", "udpout:host:99999", "tcp:host", "ttyUSB0", "/dev/ttyS0:fast"),
        *("u:1", "/dev/ttyS0:12345", "/dev/ttyS0:0"),
    ],
)
def test_invalid_connection_strings_are_refused(url):
    with pytest.raises(VariantError):
        transport_opener(url)


def test_a_listening_port_sends_to_the_autopilot_only():
    port = transport_opener("udpin:127.0.0.1:0")()
    link = AutopilotLink(lambda: port, TelemetryBuffer(), Time().clocks)
    ours, other = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    there = port._socket.getsockname()
    ours.settimeout(60)
    other.settimeout(0.2)
    other.sendto(b"hello", there)
    ours.sendto(Autopilot().heartbeat(), there)
    while link.target is None:
        link.poll(0.1)
    other.sendto(Autopilot(9).heartbeat(), there)
    link.poll(0.1)
    link.send(dialect().MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    assert decode(ours.recv(300))["name"] == "HEARTBEAT"
    with pytest.raises(TimeoutError):
        other.recv(300)
    for each in (ours, other, link):
        each.close()


def test_a_serial_port_carries_bytes_as_they_are():
    ours, theirs = pty.openpty()
    port = open_serial(os.ttyname(theirs), 921600)
    every = bytes(range(256))
    port.write(every)
    got = b""
    while len(got) < 256:
        got += os.read(ours, 300)
    os.write(ours, every)
    back = b""
    while len(back) < 256:
        back += port.read()
    assert (got, back, port.read()) == (every, every, b"")
    for fd in (ours, theirs):
        os.close(fd)
    with pytest.raises(OSError):
        for _ in range(3):
            port.read()
    port.close()
    with pytest.raises(VariantError, match="12345 baud"):
        open_serial("/dev/null", 12345)
    with pytest.raises(OSError, match="not a serial port"):
        open_serial("/dev/null", 57600)


def test_a_message_is_sent_whole_or_not_at_all(monkeypatch):
    ours, theirs = os.pipe()
    port, message = Descriptor(theirs), bytes(range(200)) * 50
    os.set_blocking(ours, False)
    with contextlib.suppress(BlockingIOError):
        while os.write(theirs, bytes(4096)):
            pass
    assert port.write(message) is False  # full
    os.read(ours, 4096)  # room for a part
    monkeypatch.setattr("select.select", lambda *waited: os.read(ours, 2**20))  # heard meanwhile
    assert port.write(message) is True
    left = b""
    with contextlib.suppress(BlockingIOError):
        while part := os.read(ours, 2**20):
            left += part
    assert left and message.endswith(left)
    for fd in (ours, theirs):
        os.close(fd)


def test_what_nobody_hears_is_not_sent(flying):
    beat = dialect().MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    assert flying.link.send(beat)
    listening = AutopilotLink(
        transport_opener("udpin:127.0.0.1:0"), TelemetryBuffer(), Time().clocks
    )
    listening.poll()
    assert not listening.send(beat)
    listening.close()


def test_a_port_that_another_thread_has_closed_is_not_read(flying, monkeypatch):
    """Its number may be that of another file by then."""
    port = flying.port

    def waited(*arguments):
        port.broken = OSError("unplugged")
        flying.link.send(dialect().MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        port.broken = None

    monkeypatch.setattr("orthonav.onboard.link.select.select", waited)
    monkeypatch.setattr(port, "fileno", lambda: 0, raising=False)
    port.coming.append(flying.autopilot.heartbeat())
    assert flying.link.poll(0.1) == 0 and port.coming


def test_a_tcp_connection_that_ends_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = server.getsockname()
        opened = transport_opener(f"tcp:{host}:{port}")()
        assert isinstance(opened, Descriptor) and opened.read() == b""
        there, _ = server.accept()
        there.sendall(b"abc")
        there.close()
        got = []
        with pytest.raises(OSError):
            wait_for(lambda: got.append(opened.read()))
        opened.close()
    assert b"".join(got) == b"abc"
    with pytest.raises(OSError):
        transport_opener(f"tcp:{host}:{port}")()


def test_the_link_thread_survives_exceptions(monkeypatch, caplog):
    port = transport_opener("udpin:127.0.0.1:0")()
    link = AutopilotLink(lambda: port, TelemetryBuffer(), Time().clocks)
    whole, calls = link._dispatch, []

    def dispatch(message, now_ns):
        calls.append(1)
        if len(calls) == 1:
            raise ZeroDivisionError("odd message")
        whole(message, now_ns)

    monkeypatch.setattr(link, "_dispatch", dispatch)
    thread = LinkThread(link)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        there, beat = port._socket.getsockname(), Autopilot().heartbeat()
        wait_for(lambda: out.sendto(beat, there) and link.counts["HEARTBEAT"])
    thread.stop()
    assert link.counts["HEARTBEAT"] > 0 and "autopilot" in caplog.text
