"""Outputs: messages as an independent decoder reads them, NMEA, lines of JSON."""

import json
import math
import os
import pty
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pynmeagps
import pytest
from fake_autopilot import UTC_NS, S, Time, fix

from orthonav.core.errors import VariantError
from orthonav.core.flight.fixes import result_from_json
from orthonav.core.records import NoFix, ViewResult
from orthonav.onboard.messages.estimate import NavigationEstimate, messages_averaged
from orthonav.onboard.messages.gate import Gate, GateRules
from orthonav.onboard.messages.mavlink import Autopilot, Origin, Packer, Target, north_east_m
from orthonav.onboard.outputs import KINDS, JsonOut, Messenger, NmeaOut, Publisher, sink_opener
from orthonav.onboard.telemetry import VehicleState
from wire import decode

ORIGIN = Origin(48.0, 2.0, 100.0)
ESTIMATE = NavigationEstimate(
    48.01, 2.01, np.eye(2) * 9.0, 0.97, utc_ns=UTC_NS, time_ns=1, vel_en_mps=(3.0, 4.0)
)
VEHICLE = VehicleState(np.eye(3), 100.0, (4.0, 3.0, 0.1), -90.0)


class Sending:
    """A messenger whose link is a list."""

    def __init__(self, *kinds, rules=None, **options):
        self.time, self.frames, self.is_open = Time(), [], True
        self.kind, self.target, self.armed = Autopilot.PX4, Target(1, 1), False
        self.origin = ORIGIN
        self.gate = Gate(rules)
        kinds = kinds or ("global-position",)
        self.messenger = Messenger(self.gate, self, self.time.clocks, kinds=kinds, **options)
        self.packer = Packer()

    def send(self, message):
        self.frames.append(decode(self.packer.pack(message)))
        return self.is_open

    def publish(self, estimate=ESTIMATE, telemetry=VEHICLE, age_s=0.25, **link):
        vars(self).update(link)
        exposed_ns = self.time.now_ns - round(age_s * S)
        return self.messenger.publish(estimate, telemetry, exposed_ns)


def test_every_message_has_the_position():
    sending = Sending(*KINDS)
    assert sending.publish() == (tuple(KINDS.values()), None)
    assert sending.gate.sent == dict.fromkeys(KINDS.values(), 1)
    read = {each["name"]: each for each in sending.frames}
    sensor, gps, command = (read[n] for n in ("GLOBAL_POSITION_SENSOR", "GPS_INPUT", "COMMAND_INT"))
    assert (sensor["lat"], sensor["lon"]) == (gps["lat"], gps["lon"]) == (480100000, 20100000)
    assert (command["command"], command["x"], command["y"]) == (43003, 480100000, 20100000)
    assert sensor["eph"] == pytest.approx(3.0) and (gps["vn"], gps["ve"]) == (4.0, 3.0)
    north, east = north_east_m(ORIGIN, 48.01, 2.01, Autopilot.PX4)
    for name in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
        place = [read[name][axis] for axis in "xyz"]
        assert place == pytest.approx((north, east, -90.0), rel=1e-5)


def test_times_are_those_of_exposure_and_sending():
    sending = Sending("global-position", "gps-input")
    sending.publish(age_s=0.25)
    sensor, gps = sending.frames
    assert sensor["processing_time"] == 250_000
    assert (sensor["time_usec"], gps["time_usec"]) == (UTC_NS // 1000 + 250_000, UTC_NS // 1000)


def test_local_messages_wait_for_the_origin_and_the_height(caplog):
    sending = Sending("odometry", "global-position")
    without = ("GLOBAL_POSITION_SENSOR",), "not_made:ODOMETRY"
    assert sending.publish(origin=None) == without
    assert sending.publish(telemetry=VehicleState(None), origin=ORIGIN) == without
    assert sending.messenger.incomplete == 2 == len(caplog.messages)
    assert sending.gate.withheld == {"not_made:ODOMETRY": 2}
    assert sending.publish(kind=Autopilot.ARDUPILOT) == (
        ("ODOMETRY", "GLOBAL_POSITION_SENSOR"),
        None,
    )
    assert sending.frames[-2]["frame_id"] == 20  # as ArduPilot reads it


def test_messages_that_the_link_does_not_take_are_not_counted_as_sent():
    sending = Sending("gps-input", rules=GateRules(min_interval_s={"GPS_INPUT": 1.0}))
    assert sending.publish(is_open=False) == ((), None)
    assert sending.gate.sent == {} and not sending.gate.withheld
    assert sending.publish(is_open=True) == ((), "rate:GPS_INPUT")
    assert sending.gate.withheld == {"rate:GPS_INPUT": 1}


def find_origin(sending, seconds, known=None, *, armed=False):
    """Names of what is sent while an autopilot is asked; `known`: the origin that it reports."""
    sending.frames.clear()
    sending.origin, sending.target, sending.armed = known, Target(3, 1), armed
    for _ in range(10 * seconds):
        sending.messenger.find_origin()
        sending.time.go(0.1)
    return [each["name"] for each in sending.frames]


@pytest.mark.parametrize("kind", ["odometry", "vision"])
def test_the_autopilot_is_asked_for_its_origin_at_a_modest_interval(kind):
    sending = Sending(kind)
    assert find_origin(sending, 10) == ["COMMAND_LONG"] * 5
    asked = sending.frames[0]
    assert (asked["command"], asked["param1"]) == (512, 49.0)
    assert (asked["target_system"], asked["target_component"]) == (3, 1)
    assert find_origin(sending, 5, ORIGIN) == []


def test_global_messages_need_no_origin_unless_the_autopilot_starts_there():
    assert find_origin(Sending("gps-input", "global-position"), 10) == []
    assert "SET_GPS_GLOBAL_ORIGIN" in find_origin(Sending("global-position", origin=ORIGIN), 10)


def test_an_origin_is_set_on_the_ground_where_the_autopilot_has_none():
    sending = Sending("vision", origin=ORIGIN)
    assert find_origin(sending, 6) == ["COMMAND_LONG"] * 3
    assert find_origin(sending, 2) == ["SET_GPS_GLOBAL_ORIGIN", "COMMAND_LONG"]
    assert (sending.frames[0]["latitude"], sending.frames[0]["target_system"]) == (480000000, 3)
    assert find_origin(sending, 6, ORIGIN) == []
    # After a restart of the autopilot it is asked again first.
    assert find_origin(sending, 2) == ["COMMAND_LONG"]


@pytest.mark.parametrize(
    ("armed", "is_open"), [(True, True), (None, True), (False, False)]
)  # by a closed link, no request was heard
def test_an_origin_is_never_set_in_flight(armed, is_open):
    sending = Sending("odometry", origin=ORIGIN)
    sending.is_open = is_open
    assert set(find_origin(sending, 60, armed=armed)) == {"COMMAND_LONG"}


def test_gps_input_carries_the_altitude_where_it_is_known():
    sending = Sending("gps-input", "global-position")
    sending.publish()
    sending.publish(telemetry=replace(VEHICLE, amsl_m=640.0))
    unknown, _, known, sensor = sending.frames
    assert unknown["ignore_flags"] & 129 == 129
    assert not known["ignore_flags"] & 129
    assert (known["alt"], known["vert_accuracy"]) == (640.0, 3.0)
    assert math.isnan(sensor["alt"])


def test_the_accuracy_for_filters_grows_with_the_rate():
    sending = Sending("global-position", "gps-input", "odometry")
    for _ in range(2):
        sending.publish()
        sending.time.go(0.5)
    averaged = messages_averaged(0.5)
    assert averaged > 5
    for frames, times in ((sending.frames[:3], 1.0), (sending.frames[3:], averaged)):
        sensor, gps, odometry = frames
        assert sensor["eph"] == gps["horiz_accuracy"] == pytest.approx(3.0 * math.sqrt(times))
        assert odometry["pose_covariance"][0] == pytest.approx(9.0 * times)


def test_the_gate_judges_the_accuracy_of_the_fix():
    sending = Sending(rules=GateRules(max_std_m=4.0))
    for _ in range(3):
        now_ns = sending.time.now_ns
        sending.publish(sending.gate.admit(replace(ESTIMATE, time_ns=now_ns), now_ns).estimate)
        sending.time.go(0.2)
    assert len(sending.frames) == 3 and not sending.gate.withheld
    assert sending.frames[-1]["eph"] > 4.0


def test_messages_are_confident_by_the_rules_of_the_gate():
    """Where an alert limit decides, they have no least confidence of their own."""
    sending = Sending("global-position", "gps-input", rules=GateRules(min_confidence=0.0))
    low = replace(ESTIMATE, confidence=0.5, time_ns=sending.time.now_ns)
    assert sending.publish(low)[1] == "not_made:GLOBAL_POSITION_SENSOR"
    admitted = sending.gate.admit(low, sending.time.now_ns).estimate
    assert sending.publish(admitted) == (("GLOBAL_POSITION_SENSOR", "GPS_INPUT"), None)
    assert sending.frames[-1]["fix_type"] == 3


@pytest.mark.parametrize(
    "kind, interval_s, too_slow",
    [(Autopilot.PX4, 0.2, 4), (Autopilot.PX4, 0.125, 0), (Autopilot.ARDUPILOT, 0.5, 0)],
)
def test_local_messages_too_slow_for_px4_are_counted(kind, interval_s, too_slow):
    sending = Sending("odometry", "global-position")
    for _ in range(5):
        sending.publish(kind=kind)
        sending.time.go(interval_s)
    assert sending.messenger.too_slow == too_slow


def sentences(data):
    return [pynmeagps.NMEAReader.parse(line + b"\r\n") for line in data.split(b"\r\n") if line]


def test_nmea_over_udp():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(60)
        out = NmeaOut(sink_opener(f"udp:127.0.0.1:{heard.getsockname()[1]}"))
        out.write(ESTIMATE, UTC_NS)
        gga, rmc, gst = sentences(heard.recv(500))
        out.write(None, UTC_NS)
        none, *_ = sentences(heard.recv(500))
        out.close()
        out.close()
    assert (gga.msgID, rmc.msgID, gst.msgID) == ("GGA", "RMC", "GST")
    assert (gga.quality, none.quality) == (6, 0)
    assert (gga.lat, rmc.lon) == pytest.approx((48.01, 2.01), abs=1e-6)


def test_nmea_over_a_serial_port_that_is_unplugged():
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    out = NmeaOut(sink_opener(f"serial:{name}:115200"))
    out.write(ESTIMATE, UTC_NS)
    assert sentences(os.read(ours, 500))[0].quality == 6
    os.close(theirs)
    os.close(ours)
    for _ in range(2):
        with pytest.raises(OSError):
            out.write(ESTIMATE, UTC_NS)
    out.close()


class Port:
    """What is written to it; a port that is not `there` fails."""

    def __init__(self):
        self.data, self.there, self.opened = b"", True, 0

    def open(self):
        self.opened += 1
        return self

    def write(self, data):
        if not self.there:
            raise OSError("unplugged")
        self.data += data

    def close(self): ...


def test_a_port_is_opened_again_after_a_failure():
    port = Port()
    out = NmeaOut(port.open)
    port.there = False
    with pytest.raises(OSError, match="unplugged"):
        out.write(ESTIMATE, UTC_NS)
    port.there = True
    out.write(ESTIMATE, UTC_NS)
    out.write(ESTIMATE, UTC_NS)
    assert port.opened == 2 and len(sentences(port.data)) == 6


def test_nmea_times_are_those_of_exposures_and_never_step_back():
    time, port = Time(), Port()
    publisher = Publisher(Gate(), time.clocks, nmea=[NmeaOut(port.open)])
    begin_ns = time.now_ns
    ages_s = [(0.1, False), (0.4, True), (0.1, True), (0.3, False), (0.2, True)]
    for age_s, is_found in ages_s:
        time.go(0.1)
        outcome = fix() if is_found else NoFix("searching", "")
        exposed_ns = time.now_ns - round(age_s * S)
        publisher.publish(
            ViewResult("a", 5, outcome, 1.0, "tracking"), exposed_ns, VEHICLE, judged=True
        )
    times = [each.time for each in sentences(port.data)]
    shown = [(each.second + each.microsecond / 1e6) for each in times]
    begin_s = (UTC_NS + begin_ns) / S % 60
    assert [each - begin_s for each in shown] == pytest.approx([0.0] * 3 + [0.2] * 3 + [0.3] * 3)
    time.utc_ahead_ns -= 3600 * S  # a clock that is set back is followed
    publisher.publish(ViewResult("a", 5, fix(), 1.0, None), time.now_ns, VEHICLE, judged=True)
    assert len(sentences(port.data)) == 12


@pytest.mark.parametrize("url", ["", "udp:here", "http://x", "serial:ttyS0", "tcp-listen:0"])
def test_invalid_urls_of_outputs_are_refused(url):
    with pytest.raises(VariantError):
        sink_opener(url)


RESULT = ViewResult("000001", UTC_NS + 5, fix(), 12.5, "tracking")


def test_lines_extend_those_of_fixes_jsonl(tmp_path):
    path = tmp_path / "lines.jsonl"
    path.write_text("an old line\n")
    out = JsonOut(path)
    out.view(RESULT, 40.25, ("GPS_INPUT",), None)
    out.health({"health": "OK", "reasons": []})
    out.view(replace(RESULT, outcome=NoFix("frozen_image", "again")), 1.0, (), "no_fix")
    out.close()
    old, first, health, second = path.read_text().splitlines()
    assert old == "an old line"
    read = result_from_json(first)
    assert (read.time_ns, read.outcome.lat_deg) == (UTC_NS + 5, 48.0)
    assert json.loads(first)["age_ms"] == 40.25 and json.loads(first)["sent"] == ["GPS_INPUT"]
    assert json.loads(health)["health"] == "OK"
    assert result_from_json(second).outcome.reason == "frozen_image"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_writing_continues_after_a_full_disk(tmp_path):
    path = tmp_path / "lines.jsonl"
    path.symlink_to("/dev/full")
    out = JsonOut(path)
    for _ in range(3):
        with pytest.raises(OSError, match="space"):
            out.view(RESULT, 1.0, (), None)
    path.unlink()  # room again
    out.view(RESULT, 2.0, (), None)
    out.close()
    lines = [line for line in path.read_text().splitlines() if line]
    assert [json.loads(line)["age_ms"] for line in lines] == [2.0]
