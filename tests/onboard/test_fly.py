"""The flight loop: every fault of a flight, and a flight over UDP from end to end."""

import contextlib
import json
import math
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.fakes import answers
from blots import AGL_M, GROUND, known_map, rendered
from fake_autopilot import (
    AHEAD_NS,
    MS,
    UTC_NS,
    FakeLocator,
    Linked,
    LiveAutopilot,
    S,
    fix,
    write_flight,
)
from paced import pace_by

from helpers import wait_for
from orthonav.cli import main
from orthonav.core.errors import CameraError, MapChangedError, MapFileError
from orthonav.core.flight.fixes import read_results, result_from_json
from orthonav.core.flight.gnss import GnssSample, fault_of, gnss_of, write_gnss
from orthonav.core.flight.heights import FlownHeights
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.confidence import ALERT_LIMIT, Acceptance
from orthonav.core.records import CONFIDENT, Fix, NoFix, Prior, Telemetry
from orthonav.onboard import cameras
from orthonav.onboard import fly as loop
from orthonav.onboard import state as states
from orthonav.onboard.cameras import CameraImage, NewestImage
from orthonav.onboard.console import Narrator
from orthonav.onboard.fly import FlyOptions, Runner
from orthonav.onboard.health import Level
from orthonav.onboard.messages.gate import Gate, GateRules
from orthonav.onboard.outputs import JsonOut, Messenger, Publisher
from orthonav.onboard.telemetry import VehicleState
from wire import decode

CAMERA = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
LEAD = 30
"""Views before a fault."""


class BoundedLog:
    """A log that records its calls; with `broken` set it raises."""

    def __init__(self):
        self.calls, self.broken, self.lost = [], None, {"views": 0}

    def __getattr__(self, name):
        def call(*arguments):
            if self.broken:
                raise self.broken
            self.calls.append((name, arguments))

        return call

    def named(self, name):
        return [arguments for called, arguments in self.calls if called == name]


class Said:
    """A console that stores its lines."""

    is_terminal = True

    def __init__(self):
        self.lines, self.warnings = [], []

    def say(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.warnings.append(text)
        self.say(text)

    def with_word(self, word):
        return [line for line in self.lines if word in line]


class Flight(Linked):
    """A runner with fake parts and a fake clock: one view every tenth of a second."""

    def __init__(
        self, tmp_path, locator=None, rules=None, kinds=("global-position", "gps-input"), **options
    ):
        super().__init__()
        clocks, self.gate = self.time.clocks, Gate(rules)
        self.lines, self.said, self.newest = tmp_path / "lines.jsonl", Said(), NewestImage()
        narrator = Narrator(
            *(self.said, clocks, self.newest, "images from 0", self.link, "udpin:1"),
            sends=True,
        )
        publisher = Publisher(
            self.gate,
            clocks,
            messenger=Messenger(self.gate, self.link, clocks, kinds=kinds),
            lines=[JsonOut(self.lines), narrator],
        )
        self.locator, self.log = locator or FakeLocator(), BoundedLog()
        fresh, gnss = options.pop("fresh", None), options.pop("gnss", None)
        camera = options.pop("camera", CAMERA)
        locators = iter([self.locator, fresh])
        self.runner = Runner(
            self.newest,
            camera,
            lambda: next(locators),
            publisher,
            FlyOptions(**options),
            link=self.link,
            sink=self.log,
            gnss=gnss,
        )
        self.number, self.yaw_deg, self.agl_m, self.talks = 0, 30.0, 100.0, True
        self.rng = np.random.default_rng(0)
        self.hear(self.autopilot.heartbeat())

    def talk(self):
        """The autopilot sends telemetry and answers TIMESYNC."""
        now = self.boot_ns()
        asked = self.port.sent("TIMESYNC") if not self.port.broken else []
        answered = answers(self.autopilot, asked, self.time.now_ns, AHEAD_NS)
        attitude = self.autopilot.attitude(now, yaw_deg=self.yaw_deg)
        self.hear(self.autopilot.home(now, self.agl_m), attitude, *answered)

    def view(self, grey=None, age_s=0.05, wait_s=0.1):
        """Process one more view; its result."""
        self.time.go(wait_s)
        if self.talks:
            self.talk()
        if grey is None:
            grey = self.rng.integers(0, 256, (240, 320), dtype=np.uint8)
        problem = None
        if isinstance(grey, NoFix):
            grey, problem = None, grey
        self.number += 1
        exposed = self.time.now_ns - round(age_s * S)
        time_ns = UTC_NS + exposed
        self.newest.put(
            CameraImage(self.number, f"{self.number:06d}", exposed, time_ns, grey, problem)
        )
        return self.runner.step(0)

    def recorded(self, telemetry, number=1):
        """Process an image that comes with its telemetry."""
        grey = self.rng.integers(0, 256, (240, 320), np.uint8)
        image = CameraImage(
            *(number, "a", self.time.now_ns, telemetry.time_ns, grey), telemetry=telemetry
        )
        self.newest.put(image)
        return self.runner.step(0)

    def views(self, count, **options):
        return [self.view(**options) for _ in range(count)]

    def health(self):
        """Level and reasons at the end of the next second."""
        before = self.runner.health
        while self.runner.health is before:
            self.time.go(0.1)
            self.link.poll()
            self.runner.step(0)
        return self.runner.health

    def reasons(self):
        return set(self.health().reasons)

    def written(self):
        return [json.loads(line) for line in self.lines.read_text().splitlines()]


@pytest.fixture
def begin(tmp_path):
    yield from beginning(Flight, tmp_path)


def beginning(kind, tmp_path):
    """Function that starts a flight of a kind, which ends after the test."""
    made = []

    def flight(*arguments, **options):
        made.append(kind(tmp_path, *arguments, **options))
        return made[-1]

    yield flight
    for each in made:
        each.runner._publisher.close()


@pytest.fixture
def flight(begin):
    """A flight after three seconds without faults."""
    made = begin()
    made.views(LEAD)
    made.port.gone.clear()
    return made


def reason_of(result):
    return result.outcome.reason if isinstance(result.outcome, NoFix) else "fix"


def test_without_faults_health_is_ok(flight):
    assert flight.health().level is Level.OK
    flight.time.go(1.0)
    flight.talk()
    flight.link.poll()
    assert flight.link.system_status == 4


def test_a_view_becomes_a_message(flight):
    flight.locator.outcome = lambda view: fix(48.1234567, -4.3210987)
    for _ in range(3):  # far from the views before: three must agree
        result = flight.view(age_s=0.05)
    read = {each["name"]: each for each in flight.port.sent()}
    for name in ("GLOBAL_POSITION_SENSOR", "GPS_INPUT"):
        assert (read[name]["lat"], read[name]["lon"]) == (481234567, -43210987)
    exposed = flight.time.now_ns - 50 * MS
    assert read["GPS_INPUT"]["time_usec"] == (UTC_NS + exposed) // 1000
    assert read["GLOBAL_POSITION_SENSOR"]["processing_time"] == 50_000
    line = [each for each in flight.written() if "frame" in each][-1]
    assert line["frame"] == result.frame and line["age_ms"] == pytest.approx(50.0)
    assert line["sent"] == ["GLOBAL_POSITION_SENSOR", "GPS_INPUT"]


def test_nothing_is_located_on_the_ground_and_in_the_take_off(begin):
    flight = begin(min_agl_m=40.0)
    flight.agl_m = 0.2
    assert {reason_of(each) for each in flight.views(20)[1:]} == {"too_low"}
    flight.agl_m = 39.0
    assert reason_of(flight.view()) == "too_low" and flight.locator.seen == []
    flight.agl_m = 41.0
    assert {reason_of(each) for each in flight.views(3)[1:]} == {"fix"}


def test_without_an_origin_local_messages_are_missing_and_everyone_is_told(begin):
    flight = begin(kinds=("odometry", "vision"))
    gone = []
    for _ in range(100):
        flight.view()
        gone += flight.port.gone
    lines = flight.written()
    withheld = [each["withheld"] for each in lines if "frame" in each]
    assert set(withheld[1:]) == {"not_made:ODOMETRY"}
    assert "no_origin" in flight.reasons()
    assert flight.written()[-1]["withheld"]["not_made:VISION_POSITION_ESTIMATE"] == 99
    said = [decode(frame) for frame in gone]
    assert any(b"no_origin" in each["text"] for each in said if each["name"] == "STATUSTEXT")
    assert any(each["name"] == "COMMAND_LONG" and each["param1"] == 49.0 for each in said)
    flight.hear(flight.autopilot.say("gps_global_origin", 480000000, 20000000, 100_000))
    flight.views(150)
    assert not flight.reasons() & {"no_origin"}
    # The velocity and the height of the local frame are still missing.
    assert "incomplete_message" in flight.reasons()
    now = flight.boot_ns()
    flight.hear(flight.autopilot.local(now, (0.0, 10.0, 0.0), -80.0))
    flight.views(2)
    line = [each for each in flight.written() if "frame" in each][-1]
    assert line["sent"] == ["ODOMETRY", "VISION_POSITION_ESTIMATE"] and line["withheld"] is None


def test_a_view_is_logged_with_its_telemetry_before_it_is_located(flight):
    before = len(flight.log.calls)
    flight.view()
    names = [name for name, _ in flight.log.calls[before:]]
    assert names[:2] == ["view", "result"]
    number, frame, grey, telemetry, latency_ms, withheld = flight.log.named("view")[-1]
    assert latency_ms is None and withheld is False
    assert telemetry is flight.locator.seen[-1] and grey.shape == (240, 320)
    assert (number, frame) == (LEAD + 1, f"{LEAD + 1:06d}")
    assert flight.log.named("result")[-1][0].frame == frame


def test_old_views_are_dropped_and_counted(flight):
    seen = len(flight.locator.seen)
    assert flight.views(40, age_s=0.6) == [None] * 40
    assert len(flight.locator.seen) == seen and flight.runner.counter.total["late"] == 40
    assert "slow" in flight.reasons() and flight.port.sent("GPS_INPUT") == []


def test_a_slow_processor_degrades_and_stale_positions_are_not_sent(flight):
    def slow(view):
        for _ in range(12):
            flight.time.go(0.1)
            flight.talk()
        return fix()

    flight.locator.outcome = slow
    flight.views(10)
    assert flight.gate.withheld["stale"] == 10 and "slow" in flight.reasons()
    assert flight.port.sent("GLOBAL_POSITION_SENSOR") == []


def test_the_search_of_the_whole_map_is_not_slow(begin):
    """It is expected to take long; views that continue a track are not."""
    flight = begin(FakeLocator(state="searching"))

    def search(view):
        flight.time.go(2.0)
        flight.locator.state_name, flight.locator.outcome = "tracking", FakeLocator().outcome
        return fix(heading_deg=view.telemetry.yaw_deg)

    flight.locator.outcome = search
    flight.views(30)
    assert flight.runner.counter.total["confident"] > 20
    assert not any("slow" in each.get("reasons", ()) for each in flight.written())


@pytest.mark.parametrize("error", [MapFileError("damaged"), ValueError("odd")])
def test_internal_errors_bridged_by_dead_reckoning_are_counted(flight, monkeypatch, error):
    """Health shows them although every view has a position."""
    monkeypatch.setattr(flight.locator, "passed", lambda telemetry, reason: fix())
    flight.locator.outcome, flight.locator.state_name = raising(error), "coasting"
    assert [reason_of(each) for each in flight.views(3)] == ["fix"] * 3
    assert flight.runner.counter.total["internal_error"] == 3
    flight.views(107)
    assert flight.health().level is Level.FAILED


def raising(error):
    def outcome(view):
        raise error

    return outcome


def test_over_a_gap_the_aircraft_is_followed_with_the_mean_velocity(begin):
    """One velocity does not say how far an aircraft flew that turned while images were late."""
    flight, own = begin(), (1.0, 2.0)
    flight.locator.outcome = lambda view: replace(fix(), vel_en_mps=own, vel_std_mps=0.5)

    def views(count, north_mps, **options):
        results = []
        for _ in range(count):
            now = flight.boot_ns()
            flight.hear(flight.autopilot.local(now, (north_mps, 0.0, 0.0)))
            results += flight.views(1, **options)
        return results

    assert views(20, 20.0)[-1].outcome.vel_en_mps == own
    views(10, 20.0, age_s=0.6)
    views(10, -10.0, age_s=0.6)
    first, second = views(2, -10.0)[-2:]
    mean, now = (each.vel_en_mps for each in flight.locator.seen[-2:])
    assert mean == (0.0, pytest.approx(5.0, abs=1.5)) and now == (0.0, -10.0)
    # The velocity of the fix is that of the moment: its error is that of the mean.
    assert first.outcome.vel_en_mps == (1.0, pytest.approx(2.0 + (-10.0 - mean[1])))
    assert second.outcome.vel_en_mps == own


SAME = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
UNUSABLE = {
    "bad_image": (NoFix("bad_image", "cut short"), "bad_image"),
    "frozen_image": (SAME, "frozen"),
    "too_dark": (np.zeros((240, 320), np.uint8), "bad_image"),
    "too_bright": (np.full((240, 320), 255, np.uint8), "bad_image"),
    "blank": (np.full((240, 320), 120, np.uint8), "bad_image"),
}
DARK = UNUSABLE["too_dark"][0]


@pytest.mark.parametrize("reason", UNUSABLE)
def test_over_unusable_images_the_track_is_predicted_and_nothing_is_sent(flight, reason):
    """Whatever the track says there. The locator finds out itself that a picture is too dark."""
    grey, counted = UNUSABLE[reason]
    flight.view(grey)
    flight.port.gone.clear()
    predicted, located = len(flight.locator.bridged), len(flight.locator.seen)
    logged = len(flight.log.named("view"))
    flight.views(30, grey=grey)
    lines = [line for line in flight.written() if "frame" in line][-30:]
    assert {(line["withheld"], *line["sent"]) for line in lines} == {(reason,)}
    assert flight.gate.withheld[reason] >= 30
    assert flight.port.sent("GLOBAL_POSITION_SENSOR") == flight.port.sent("GPS_INPUT") == []
    bridged = len(flight.locator.bridged) - predicted
    # Once a second: the noise of a prediction is per view.
    assert (bridged, len(flight.locator.seen) - located) == (
        (3, 0) if reason in ("bad_image", "frozen_image") else (0, 3)
    )
    # A replay of the log does as much: it has no picture to locate.
    assert [each[2] is None for each in flight.log.named("view")[logged:]] == [bridged == 3] * 3
    assert flight.runner.counter.total[counted] >= 30
    assert {"frozen": "frozen_image", "bad_image": "bad_images"}[counted] in flight.reasons()
    assert reason_of(flight.views(2)[1]) == "fix"
    assert flight.gate.resets == 0  # an interruption is no jump


@pytest.mark.parametrize("vehicle, predicted", [(VehicleState(None), 4), (None, 40)])
def test_of_a_ros_graph_too_the_track_is_predicted_once_a_second(begin, vehicle, predicted):
    """A replay of a recording predicts to every view, as `orthonav localize`."""
    flight = begin(recorded=True)
    flight.recorded(Telemetry(0, 1.0, 2.0, 3.0, 50.0))
    for number in range(1, 41):
        flight.time.go(0.1)
        problem, telemetry = (
            NoFix("bad_image", ""),
            Telemetry(number * S // 10, 1.0, 2.0, 3.0, 50.0),
        )
        stamped = number, "a", flight.time.now_ns, telemetry.time_ns
        flight.newest.put(CameraImage(*stamped, None, problem, telemetry, vehicle))
        flight.runner.step(0)
    assert len(flight.locator.bridged) == predicted


def test_a_view_that_is_blank_beside_the_mask_of_the_camera_is_a_bad_image(begin):
    """What is behind the mask, as a landing gear, does not make a picture of fog usable."""
    gear = np.full((240, 320), 255, np.uint8)
    gear[120:] = 0
    flight = begin(camera=CAMERA.masked(gear))
    grey = flight.rng.integers(0, 256, (240, 320), dtype=np.uint8)
    assert reason_of(flight.views(2)[1]) == "fix"
    grey[:120] = 120
    large = np.repeat(np.repeat(grey, 2, axis=0), 2, axis=1)  # the mask is that of its size
    for each in (grey, large):
        flight.view(each)
        line = flight.written()[-1]
        assert line["withheld"] == "blank"
    assert flight.runner.counter.total["bad_image"] == 2


def test_an_image_of_other_proportions_fails_and_one_of_another_size_does_not(flight):
    cameras = []

    def outcome(view):
        cameras.append(view.camera)
        return fix()

    flight.locator.outcome = outcome
    assert reason_of(flight.view(flight.rng.integers(0, 256, (480, 640), np.uint8))) == "fix"
    assert (cameras[0].width_px, cameras[0].fx_px) == (640, 400.0)
    flight.locator.passed = lambda telemetry, reason: reason  # no track yet
    wrong = flight.view(flight.rng.integers(0, 256, (240, 240), np.uint8))
    assert reason_of(wrong) == "wrong_camera" and "calibrate" in wrong.outcome.detail
    assert flight.health().level is Level.FAILED


def test_without_telemetry_there_is_no_fix(flight):
    flight.talks = False
    results = flight.views(40)
    assert reason_of(results[0]) == "fix"  # the last attitude holds for a moment
    assert {reason_of(each) for each in results[3:]} == {"no_telemetry"}
    assert "yaw_deg" in results[-1].outcome.detail
    assert {"no_telemetry", "link_down"} & set(flight.health().reasons)
    assert flight.health().level is Level.FAILED
    flight.talks = True
    flight.view()
    assert reason_of(flight.view()) == "fix"


def test_a_link_that_failed_is_opened_again(flight):
    flight.port.broken = OSError("unplugged")
    flight.views(60)
    assert "link_down" in flight.reasons() and not flight.link.is_open
    assert flight.runner.counter.total["no_telemetry"] > 0
    flight.port.broken = None
    flight.views(70)
    assert flight.port.sent("GPS_INPUT") != []
    flight.views(40)
    assert flight.health().level is Level.OK


def test_telemetry_after_a_restart_of_the_autopilot_is_used(flight):
    started = flight.time.now_ns

    def talk():
        now = flight.time.now_ns - started
        flight.hear(flight.autopilot.home(now, 100.0), flight.autopilot.attitude(now, yaw_deg=77.0))

    flight.talk = talk
    flight.views(20)
    assert flight.locator.seen[-1].yaw_deg == pytest.approx(77.0, abs=0.01)
    assert "clock_jumped" in flight.reasons()


@pytest.mark.parametrize("seconds", [3600, -3600])
def test_a_computer_clock_that_is_set_does_no_harm(flight, seconds):
    flight.time.utc_ahead_ns += seconds * S
    flight.port.gone.clear()
    assert reason_of(flight.view()) == "fix"
    utc_us = flight.port.sent("GPS_INPUT")[0]["time_usec"]
    assert utc_us == (flight.time.clocks.utc_ns() - 50 * MS) // 1000
    assert flight.gate.resets == 0 and "clock_jumped" in flight.reasons()
    assert {"stale", "out_of_order", "from_the_future"} & set(flight.gate.withheld) == set()


def test_a_large_mismatch_of_heading_or_height_degrades(flight):
    flight.locator.outcome = lambda view: fix(heading_deg=view.telemetry.yaw_deg + 35)
    flight.views(11)
    assert flight.reasons() == {"heading_mismatch"}
    flight.locator.outcome = lambda view: fix(
        heading_deg=view.telemetry.yaw_deg, agl_m=view.telemetry.agl_m / 2
    )
    flight.views(11)
    assert flight.reasons() == {"height_mismatch"}


def test_a_map_changed_in_place_fails_and_stops_positions(begin):
    changes = [None]
    flight = begin(map_change=lambda: changes[0])
    flight.views(60)
    assert flight.health().level is Level.OK and flight.port.sent("GPS_INPUT")
    changes[0] = "5 bytes instead of 9"
    flight.port.gone.clear()
    flight.views(11)
    assert flight.health().level is Level.FAILED and "map_file_changed" in flight.reasons()
    assert flight.port.sent("GPS_INPUT") == []
    views = [line for line in flight.written() if "frame" in line]
    assert {line["reason"] for line in views[-11:]} == {"map_file_changed"}


def test_a_log_that_fails_does_not_end_the_flight(flight):
    flight.log.broken = OSError(28, "No space left on device")
    assert {reason_of(each) for each in flight.views(11)} == {"fix"}
    assert flight.reasons() == {"log_failed"}
    flight.log.broken = None
    flight.views(120)
    assert flight.health().level is Level.OK
    flight.log.lost = {"views": 3}  # dropped by a log that never raises
    flight.views(11)
    assert flight.reasons() == {"log_failed"}


def test_an_output_that_fails_does_not_end_the_flight(flight, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(JsonOut, "view", full)
    flight.views(11)
    assert flight.port.sent("GPS_INPUT") != [] and flight.reasons() == {"output_failed"}


def test_a_camera_that_stops_is_a_failure(flight):
    for _ in range(50):
        flight.time.go(0.1)
        flight.talk()
        flight.runner.step(0)
    health = flight.health()
    assert (health.level, health.reasons) == (Level.FAILED, ("no_camera",))
    flight.newest.outages += 1
    flight.views(11)
    assert flight.reasons() == {"camera_lost"}


def test_health_goes_to_the_ground_station(flight):
    texts = []
    for _ in range(100):
        flight.view(grey=DARK)
        texts += [frame for frame in flight.port.gone if b"orthonav DEGRADED: " in frame]
    assert 0 < len(texts) <= 2  # at most one in five seconds
    heard = flight.written()
    assert [each for each in heard if each.get("health") == "DEGRADED"]
    assert flight.link.system_status == Level.DEGRADED.value


@pytest.mark.parametrize(("least", "confident"), [(0.9, True), (0.99, False)])
def test_results_are_confident_by_the_criterion_of_the_flight(begin, least, confident):
    """Of a fix with 0.97."""
    flight = begin(accept=Acceptance("confidence", least))
    result = flight.views(3)[-1]
    assert reason_of(result) == "fix" and result.is_confident is confident


def test_positions_beyond_the_alert_limit_are_withheld_and_said(begin):
    """While the place is uncertain, and again while the position is."""
    shown = {"place": 0.9999, "std_m": 2.0}

    def outcome(view):
        found = fix(std_m=shown["std_m"], heading_deg=view.telemetry.yaw_deg)
        return replace(found, place_probability=shown["place"])

    locator = FakeLocator(outcome)
    accept = Acceptance(ALERT_LIMIT, 35.0, 1e-3)
    rules = GateRules(min_confidence=0.0, alert_limit_m=35.0)
    flight = begin(locator, rules, accept=accept)
    assert flight.views(30)[-1].is_confident and flight.health().level is Level.OK
    told = flight.written()
    assert told[-2]["sent"] and told[-2]["protection_level_m"] < 35 and told[-2]["risk"] == 1e-3
    sent = flight.gate.sent.copy()
    shown["std_m"] = 20.0
    result = flight.views(60)[-1]
    level_m = result.outcome.protection_level_m(1e-3)
    assert 35 < level_m < math.inf and not result.is_confident
    assert flight.gate.sent == sent and flight.gate.withheld["alert_limit"] == 60
    assert flight.health().reasons == ("unavailable",)
    text = r"protection level (\d+) m, above the alert limit 35 m for \d"
    said = re.search(f"unavailable: {text}", flight.runner.health.text())
    assert said is not None and abs(int(said[1]) - level_m) < 2
    assert re.search(rf"unavailable \({text}", flight.said.warnings[-1])
    health = [line for line in flight.written() if "health" in line][-1]
    assert health["alert_limit_m"] == 35 and 5.5 < health["unavailable_s"] < 8
    assert health["protection_level_m"] == pytest.approx(level_m, abs=0.1)
    shown.update(place=0.99, std_m=2.0)
    flight.views(10)
    assert flight.gate.sent == sent and "protection level infinite, above" in flight.health().text()
    shown["place"] = 0.9999
    assert flight.views(20)[-1].is_confident
    assert flight.health().level is Level.OK and flight.gate.sent != sent
    assert flight.gate.resets == 0


def test_the_position_is_saved_about_once_a_second(begin, tmp_path, monkeypatch):
    path, saves = tmp_path / "state.json", []
    whole = states.save
    monkeypatch.setattr(states, "save", lambda *a: (saves.append(1), whole(*a)))
    flight = begin(state_path=path)
    flight.views(60)
    assert 4 <= len(saves) <= 7
    saved = states.load(path)
    assert (saved.lat_deg, saved.lon_deg, saved.std_m) == (48.0, 2.0, pytest.approx(2.0))
    assert saved.age_s(flight.time.clocks.utc_ns(), flight.time.now_ns, states.boot_id()) < 1.2
    flight.views(130, grey=DARK)
    later = states.load(path)
    assert later.mono_ns - saved.mono_ns < S
    monkeypatch.setattr(states, "save", lambda *a: (_ for _ in ()).throw(OSError("read only")))
    flight.views(11)
    assert "state_not_saved" in flight.reasons()


def test_the_first_located_view_gets_the_start_position(begin):
    prior = Prior(48.0, 2.0, 50.0)
    flight = begin(start=lambda: prior)
    for name in ("bad_image", "too_dark"):
        assert reason_of(flight.view(UNUSABLE[name][0])) == name  # there is no track to predict
    flight.views(3)
    assert [each.prior for each in flight.locator.seen] == [prior, None, None]
    assert flight.locator.bridged == []


def test_time_that_goes_back_begins_the_track_again(begin, caplog):
    """A bag that is played in a loop: the second pass knows nothing of the first but the start."""
    start, second = Prior(48.0, 2.0, 5.0), FakeLocator()
    flight = begin(recorded=True, start=lambda: start, fresh=second)
    for number, time_s in enumerate((100, 101, 100.5, 50, 51)):
        flight.recorded(Telemetry(round(time_s * S), 1.0, 2.0, 3.0, 50.0), number)
    first = flight.locator.seen
    assert [each.time_ns / S for each in first] == [100, 101, 100.5]
    assert [each.time_ns / S for each in second.seen] == [50, 51]
    for seen in (first, second.seen):
        assert [each.prior for each in seen][:2] == [start, None]
    assert caplog.text.count("time went back by 50.5 s") == 1


def level(lat_deg, lon_deg):
    return np.full(np.shape(lat_deg), 300.0)


def test_a_map_with_terrain_gives_heights_above_ground(begin):
    """Also the first view, by its start position, and where only a height above sea is known."""
    north_deg = 10.0  # metres of terrain per degree

    def terrain(lat_deg, lon_deg):
        return 300.0 + north_deg * (np.asarray(lat_deg) - 48.0)

    lat, lon = np.linspace(47.0, 49.0, 9), np.full(9, 2.0)
    for prior, agl_m in ((None, 100.0), (Prior(49.0, 2.0, 5.0), 90.0)):
        heights = FlownHeights(terrain, (lat, lon))
        # The start is not lost where its own ground is near: it is given once.
        flight = begin(recorded=True, heights=heights, start=[prior].pop, min_agl_m=95.0)
        telemetry = Telemetry(5, 1.0, 2.0, 3.0, math.nan, amsl_m=400.0)
        assert reason_of(flight.recorded(telemetry)) == "fix"
        (seen,) = flight.locator.seen
        assert seen.prior == prior
        assert seen.agl_m == pytest.approx(agl_m, abs=0.1) and seen.amsl_m == 400.0
        (view,) = flight.log.named("view")
        assert view[3] == seen  # a replay of the log has the height that was flown with


def test_over_an_unknown_datum_heights_above_sea_give_no_fix(begin):
    heights = FlownHeights(level, (np.zeros(2), np.zeros(2)), datum_known=False)
    flight = begin(recorded=True, heights=heights, start=[None].pop)
    above_sea = Telemetry(5, 1.0, 2.0, 3.0, math.nan, amsl_m=400.0)
    refused = flight.recorded(above_sea).outcome
    assert refused.reason == "no_telemetry" and "--dem-datum" in refused.detail
    assert flight.locator.seen == []
    above_home = Telemetry(10**9, 1.0, 2.0, 3.0, math.nan, amsl_m=0.0, home_m=100.0)
    assert reason_of(flight.recorded(above_home)) == "fix"
    assert flight.locator.seen[0].agl_m == pytest.approx(100.0)


def test_gps_input_has_the_altitude_by_the_terrain_where_the_autopilot_knows_none(begin):
    heights = FlownHeights(level, (np.zeros(2), np.zeros(2)), take_off=(48.0, 2.0, 5.0))
    flight = begin(heights=heights)
    flight.views(3)  # 100 m above the place of take-off
    (message,) = flight.port.sent("GPS_INPUT")
    assert message["alt"] == pytest.approx(400.0) and not message["ignore_flags"] & 1


@pytest.mark.parametrize(
    "error, reason",
    [(MapFileError("damaged"), "map_damaged"), (MapChangedError("cut"), "map_file_changed")],
)
def test_terrain_that_cannot_be_read_gives_no_fix(begin, error, reason):
    broken = []

    def terrain(lat_deg, lon_deg):
        if broken:
            raise error
        return np.zeros(np.shape(lat_deg))

    flight = begin(heights=FlownHeights(terrain, (np.zeros(2), np.zeros(2))))
    flight.runner.options.heights.observe(UTC_NS + flight.time.now_ns, fix(), "tracking")
    broken.append(True)
    assert [reason_of(result) for result in flight.views(2)] == [reason] * 2
    assert flight.locator.seen == []


def test_the_flight_ends_with_the_recording(flight):
    flight.newest.end()
    flight.runner.run(threading.Event())
    assert [name for name, _ in flight.log.calls[-1:]] == ["close"]
    assert flight.log.named("options")


def test_a_camera_error_of_the_locator_is_a_wrong_camera(flight):
    flight.locator.outcome = raising(CameraError("another camera"))
    assert reason_of(flight.view()) == "wrong_camera"
    assert flight.health().level is Level.FAILED


def test_inputs_that_are_missing_come_and_go_are_said(flight):
    flight.views(30)  # four seconds more
    said = flight.said.lines
    assert "autopilot 1/1 PX4 heard on udpin:1" in said
    assert not flight.said.with_word("waiting")
    status = flight.said.with_word("; health OK")[-1]
    assert status.startswith("tracking 48.000000, 2.000000 +- 2.0 m; ")
    flight.talks = False
    for _ in range(200):  # neither images nor messages for twenty seconds
        flight.time.go(0.1)
        flight.runner.step(0)
    assert flight.said.with_word("FAILED: no_camera (no image)")
    assert len(flight.said.with_word("link_down (no message from the autopilot)")) == 1
    flight.talks = True
    flight.views(120)
    assert flight.said.lines[-1].endswith("health OK")


def test_a_camera_that_cannot_be_opened_is_named_while_it_is_waited_for(begin):
    flight, pauses = begin(), []
    camera = cameras.LiveCamera(4242, flight.time.clocks)
    cameras.read_into(flight.newest, camera, lambda: len(pauses) > 2, pauses.append)
    flight.health()
    text = "waiting for images; camera cannot be opened: /dev/video4242"
    assert flight.said.with_word("images") == [text]


def test_inputs_are_waited_for(begin):
    flight = begin()
    flight.talks = False
    for _ in range(200):
        flight.time.go(0.1)
        flight.runner.step(0)
    for missing in ("images from 0", "ATTITUDE of autopilot 1/1"):
        assert 2 <= len(flight.said.with_word(f"waiting for {missing}")) <= 3
    flight.views(10)
    assert "waiting" not in flight.said.lines[-1]


def test_states_and_faults_are_said_with_their_reason_and_a_summary_ends_it(flight):
    said = flight.said
    flight.locator.state_name = "coasting"
    flight.views(5)
    assert "tracking -> coasting: views do not show the map" in said.warnings[-1]
    flight.locator.state_name = "tracking"
    flight.views(5)
    assert said.lines[-1].startswith("coasting -> tracking: 48.000000, 2.000000 +- 2.0 m")
    flight.locator.outcome = lambda view: fix(heading_deg=view.telemetry.yaw_deg + 35)
    flight.views(80)
    assert len(said.with_word("DEGRADED: heading_mismatch (")) == 1
    flight.locator.outcome = FakeLocator().outcome
    flight.views(80)
    assert "health OK" in said.lines
    flight.runner._publisher.close()
    assert said.lines[-1].startswith("end: 200 views, 194 sent, 6 withheld: coasting 5, ")


def test_a_start_that_is_contradicted_degrades_for_a_while(begin):
    locator = FakeLocator(lambda *_: NoFix("searching", ""), "searching")
    flight = begin(locator, start=lambda: Prior(48.0, 2.0, 100.0))
    flight.views(40)
    assert flight.reasons() == {"searching"}
    locator.state_name, locator.outcome = "tracking", lambda *_: fix(48.02, 2.0, heading_deg=30.0)
    flight.views(20)
    assert flight.reasons() == {"start_mismatch"}
    assert flight.written()[-1]["start_off_m"] == pytest.approx(2224, abs=10)
    assert flight.said.with_word("start_mismatch (the ground contradicts the start position, 2,22")
    flight.views(310)
    assert flight.reasons() == set()


def test_a_start_within_its_deviation_and_the_motion_since_is_right(begin):
    locator = FakeLocator(lambda *_: NoFix("searching", ""), "searching")
    flight = begin(locator, start=lambda: Prior(48.0, 2.0, 100.0))
    flight.views(100)  # ten seconds at up to 30 m/s
    locator.state_name, locator.outcome = "tracking", lambda *_: fix(48.005, 2.0, heading_deg=30.0)
    flight.views(20)  # 556 m north
    assert flight.reasons() == set()


# From here on with a map, over UDP.

STEP_M, HEADING, EVERY_S = 14.0, 60.0, 0.5
ALONG = np.array([math.sin(math.radians(HEADING)), math.cos(math.radians(HEADING))])
COUNT = 20
PACED = Path(__file__).parent / "paced.py"


@pytest.fixture(scope="module")
def flown(made_once, make_ortho, tmp_path_factory):
    """A map, a flight folder over it, and the frame of the map."""
    folder = tmp_path_factory.mktemp("fly")
    _, path, frame = known_map(made_once, make_ortho)
    rng = np.random.default_rng(0)
    seen, truth = [], {}
    for number in range(COUNT):
        place = np.array([-120.0, -80.0]) + number * STEP_M * ALONG
        grey = rendered(GROUND, place, (HEADING, 0.0, 0.0), AGL_M, CAMERA)
        grey = np.clip(0.75 * grey + 30 + rng.normal(0, 6, grey.shape), 0, 255).astype(np.uint8)
        telemetry = Telemetry(round(number * EVERY_S * S), HEADING, 0.0, 0.0, AGL_M)
        seen.append((grey, telemetry))
        truth[f"{number:03d}.png"] = place
    write_flight(folder / "flight", CAMERA, seen)
    return path, folder / "flight", frame, truth


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def level_flight(autopilot, boot_ns):
    """Telemetry while GNSS is received."""
    us, receiver = boot_ns // 1000, (3, 0, 0, 0, 0, 0, 0, 0, 9)
    return [
        autopilot.distance(boot_ns, AGL_M),
        autopilot.attitude(boot_ns, yaw_deg=HEADING),
        autopilot.say("estimator_status", us, 831, 0, 0, 0, 0, 0, 0, 0, 0),
        autopilot.say("gps_raw_int", us, *receiver),
    ]


@pytest.fixture
def autopilot():
    port = free_port()
    fake_autopilot = LiveAutopilot(port, level_flight)
    fake_autopilot.port = port
    fake_autopilot.start()
    yield fake_autopilot
    fake_autopilot.stop()


def views_in(path):
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    texts = [line for line in path.read_text().splitlines() if '"frame"' in line]
    return [line for line in lines if "frame" in line], [result_from_json(t) for t in texts]


@pytest.fixture
def paced(monkeypatch):
    """Function that makes a playback wait until a line was written for every earlier image."""

    def pace(lines):
        paced = pace_by(lines)
        monkeypatch.setattr(cameras, "own_pace", paced)
        monkeypatch.setattr(cameras, "autopilot_pace", lambda _, *given: paced(*given))
        monkeypatch.setattr(loop, "MAX_AGE_S", 60.0)

    return pace


def test_a_flight_from_end_to_end(flown, autopilot, paced, monkeypatch, tmp_path):
    """Every image is located, however slow the machine is; only "stale" depends on its speed."""
    monkeypatch.setattr(loop, "TELEMETRY_WAIT_S", 10.0)
    path, folder, frame, truth = flown
    lines, state = tmp_path / "lines.jsonl", tmp_path / "state.json"
    cv2.setNumThreads(1)
    paced(lines)
    code = main(
        [
            *("fly", str(path), str(folder), "--autopilot", f"udpin:{autopilot.port}"),
            *("--send", "global-position", "--send", "gps-input"),
            *("--jsonl", str(lines), "--state", str(state)),
        ]
    )
    assert code == 0
    written, results = views_in(lines)
    assert [each.frame for each in results] == sorted(truth)
    confident = [
        (line, each)
        for line, each in zip(written, results, strict=True)
        if each.state == "tracking" and each.outcome.confidence >= CONFIDENT
    ]
    assert len(confident) >= 2 * COUNT // 5, [line["withheld"] for line in written]
    for line, each in confident:
        place = frame.en_from_latlon(each.outcome.lat_deg, each.outcome.lon_deg)
        assert np.hypot(*(place - truth[each.frame])) < 6
        assert line["sent"] or line["withheld"] == "stale"
    sent = [each for line, each in zip(written, results, strict=True) if line["sent"]]
    assert sent, [line["withheld"] for line in written]
    for name in ("GLOBAL_POSITION_SENSOR", "GPS_INPUT"):
        wait_for(lambda name=name: len(autopilot.named(name)) >= len(sent))
        assert [(m["lat"], m["lon"]) for m in autopilot.named(name)] == [
            (round(r.outcome.lat_deg * 1e7), round(r.outcome.lon_deg * 1e7)) for r in sent
        ]
    assert all(m["processing_time"] > 0 for m in autopilot.named("GLOBAL_POSITION_SENSOR"))
    assert autopilot.named("HEARTBEAT") and autopilot.named("TIMESYNC")
    assert states.load(state).lat_deg == pytest.approx(confident[-1][1].outcome.lat_deg)


def test_a_flight_is_localized_as_it_was_flown_over_dark_pictures_too(flown, paced, run, tmp_path):
    """Dead reckoning bridges them in both; the loop sends nothing there."""
    path, recorded, _, truth = flown
    folder, lines = shutil.copytree(recorded, tmp_path / "flight"), tmp_path / "lines.jsonl"
    dark = sorted(truth)[12:14]
    for name in dark:
        (picture,) = folder.rglob(name)
        cv2.imwrite(str(picture), np.zeros((240, 320), np.uint8))
    paced(lines)
    assert run("fly", path, folder, "--recorded-telemetry", "--jsonl", lines).code == 0
    fixes = tmp_path / "fixes.jsonl"
    assert run("localize", path, folder, "--track", "--out", fixes).code == 0
    written, in_flight = views_in(lines)
    again = read_results(fixes)
    assert [(each.frame, each.state, each.outcome) for each in in_flight] == [
        (each.frame, each.state, each.outcome) for each in again
    ]
    bridged = [each for each in again if each.frame in dark]
    assert all(isinstance(each.outcome, Fix) and each.state == "coasting" for each in bridged)
    withheld = [line["withheld"] for line in written if line["frame"] in dark]
    assert withheld == ["too_dark"] * 2 and again[-1].state == "tracking"


@pytest.mark.long
def test_gnss_of_a_recording_is_compared(flown, paced, run, tmp_path):
    """A receiver that jumps away at the middle of the flight; views carry its position."""
    path, recorded, frame, truth = flown
    folder = shutil.copytree(recorded, tmp_path / "flight")
    step_m, lines = 60.0, tmp_path / "lines.jsonl"
    samples = []
    for number, place in enumerate(truth.values()):
        off = [step_m, 0.0] if number >= COUNT // 2 else [0.0, 0.0]
        lat, lon = frame.latlon_from_en(place + off)
        time_ns = round(number * EVERY_S * S)
        samples.append(
            GnssSample(time_ns, time_ns, float(lat), float(lon), 3, 1.5, stamp_ns=time_ns)
        )
    command = [
        *("fly", path, folder, "--recorded-telemetry", "--gnss", "watch", "--jsonl", lines),
        *("--log", tmp_path / "log.mcap"),
    ]
    done = run(*command)
    assert done.code == 1 and "gnss.csv" in done.err
    lines.unlink(missing_ok=True)
    write_gnss(folder / "gnss.csv", samples)
    paced(lines)
    assert run(*command).code == 0
    _, results = views_in(lines)
    off_m = []
    for each in results:
        place = frame.en_from_latlon(*gnss_of(each.outcome.evidence))
        off_m.append(np.hypot(*(place - truth[each.frame])))
    assert max(off_m[: COUNT // 2]) < 1 and min(off_m[COUNT // 2 :]) > step_m - 1
    assert fault_of(results[0].outcome.evidence) == ""
    assert "gnss_jump" in {fault_of(each.outcome.evidence) for each in results}
    log = b"".join(each.read_bytes() for each in tmp_path.glob("log_*.mcap"))
    assert b"/orthonav/gnss" in log


def in_process(autopilot, path, images, *, lines, state, **how):
    """A flight in a process of its own, held from its first message on until `release` is there."""
    release = lines.parent / "release"
    words = [lines, release, "fly", path, images, "--state", state, "--jsonl", lines]
    words += ["--autopilot", f"udpin:{autopilot.port}"]
    return subprocess.Popen([sys.executable, PACED, *map(str, words)], **how)


@pytest.mark.long
def test_a_killed_flight_continues_from_the_saved_position(flown, autopilot, tmp_path):
    """A process is killed in flight; the next one starts from the position that it saved."""
    path, folder, _, _ = flown
    state = tmp_path / "state.json"

    first = in_process(autopilot, path, folder, lines=tmp_path / "1.jsonl", state=state)
    try:
        wait_for(state.exists, process=first)
    finally:
        first.send_signal(signal.SIGKILL)
        first.wait()
    heard = len(autopilot.named("GLOBAL_POSITION_SENSOR"))
    assert heard > 0
    rest = shutil.copytree(folder, tmp_path / "rest")  # the aircraft flies on from there
    names, *views = (rest / "telemetry.csv").read_text().splitlines()
    flown_views = (tmp_path / "1.jsonl").read_text().count('"frame"')
    (rest / "telemetry.csv").write_text("\n".join([names, *views[flown_views:]]) + "\n")
    second = in_process(autopilot, path, rest, lines=tmp_path / "2.jsonl", state=state)
    try:
        wait_for(lambda: len(autopilot.named("GLOBAL_POSITION_SENSOR")) > heard, process=second)
    finally:
        second.send_signal(signal.SIGTERM)
        code = second.wait()
    assert code == 0  # a clean stop


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [
        "truncated",
        pytest.param("emptied", marks=pytest.mark.slow),
        pytest.param("rewritten", marks=pytest.mark.slow),
    ],
)
def test_a_map_changed_in_place_in_flight_stops_positions_only(flown, autopilot, tmp_path, how):
    """A process of its own: reading a mapped file beyond its end would kill it with SIGBUS."""
    path, folder, _, _ = flown
    area, lines, state = tmp_path / "area.onav", tmp_path / "lines.jsonl", tmp_path / "state.json"
    area.write_bytes(path.read_bytes())
    how = {"stderr": subprocess.PIPE, "text": True}
    process = in_process(autopilot, area, folder, lines=lines, state=state, **how)
    try:
        wait_for(state.exists, process=process)  # a confident position was found
        size = area.stat().st_size
        if how == "rewritten":
            with area.open("r+b") as stream:
                stream.write(bytes(size + 1))  # another size, as another map has
        else:
            os.truncate(area, size // 3 if how == "truncated" else 0)
        (tmp_path / "release").touch()
        wait_for(lambda: '"reason": "map_file_changed"' in lines.read_text(), process=process)
    finally:
        process.send_signal(signal.SIGTERM)
        err = process.communicate()[1]
    assert process.returncode == 0 and "Traceback" not in err, err
    written = [json.loads(line) for line in lines.read_text().splitlines()]
    views = [line for line in written if "frame" in line]
    first = next(i for i, line in enumerate(views) if line["reason"] == "map_file_changed")
    assert any(line["status"] == "fix" for line in views[:first])
    for line in views[first:]:
        assert (line["status"], line["reason"]) == ("no_fix", "map_file_changed")
        assert not line["sent"] and "bytes instead of" in line["detail"]


@pytest.mark.parametrize(
    ("options", "code", "word"),
    [
        ((), 2, "--autopilot"),
        (("--autopilot", "udpin:0", "--signing-key", "KEY"), 1, "32 bytes"),
        (("--autopilot", "carrier-pigeon:1"), 2, "udpin"),
        (("--autopilot", "udpin:0", "--nmea", "x:1"), 2, "udp:HOST:PORT"),
        (("--autopilot", "udpin:0", "--nmea", "udp:10.0.0.9"), 2, "udp:10.0.0.9:10110"),
        (("--autopilot", "udpin:10.0.0.9"), 2, "such as udpin:10.0.0.9:14550, got"),
        (("--start", "-33.9,18.4,50"), 2, "--autopilot"),
        (("--autopilot", "udpin:0", "--start", "1,2"), 2, "LAT,LON,STD_M"),
    ],
)
def test_invalid_options_are_refused(flown, run, tmp_path, options, code, word):
    path, folder, _, _ = flown
    key = tmp_path / "key"
    key.write_text("secret words")
    done = run("fly", path, folder, *(key if each == "KEY" else each for each in options))
    assert done.code == code and word in done.err and "secret" not in done.err


def test_a_start_far_off_the_map_ends_the_program_and_a_near_one_is_a_warning(flown, run, tmp_path):
    path, folder, frame, _ = flown
    lines = tmp_path / "lines.jsonl"
    options = ("--recorded-telemetry", "--pace", "1000", "--jsonl", lines)

    def start(*values):
        text = ",".join(map(str, values))
        return run("fly", path, folder, *options, "--start", text)

    lat, lon = frame.lat_deg, frame.lon_deg
    for values, words in {
        (lat + 0.05, lon, 50): "5.2 km from the map",
        (lon, lat, 50): "seem to be swapped",
        (120, 46, 50): "seem to be swapped",
        (lat, lon, 0): "above 0 m",
        (-33.9, 18.4, 50): "km from the map",
    }.items():
        done = start(*values)
        assert (done.code, done.err.count("\n")) == (2, 1) and words in done.err
        assert not lines.exists()
    for off_deg, std_m in ((0.02, 50), (0.05, 2000)):
        done = start(lat + off_deg, lon, std_m)
        assert done.code == 0 and "WARNING: --start is" in done.err


def test_a_dry_run_of_a_recording_speaks_on_stderr_and_its_data_stay_alone_on_stdout(
    flown, run, paced, tmp_path
):
    path, folder, _, _ = flown
    paced(tmp_path / "lines.jsonl")
    command = ("fly", path, folder, "--recorded-telemetry", "--dry-run")
    done = run(*command, "--jsonl", "-", "--jsonl", tmp_path / "lines.jsonl")
    views = [each for each in map(json.loads, done.out.splitlines()) if "frame" in each]
    assert done.code == 0 and views
    texts = [line[12:] for line in done.err.splitlines()]
    plan = [text.partition(":")[0] for text in texts[:6]]
    assert plan == ["map", "autopilot", "sends", "start", "GNSS", "camera"]
    assert any(text.startswith("searching -> tracking: 46.") for text in texts)
    found = sum(each["withheld"] is None for each in views)
    end = f"end: {len(views)} views, {found} with a position (none is sent)"
    assert texts[-1].startswith(end)
    paced(tmp_path / "quiet.jsonl")
    done = run(*command, "--quiet", "--jsonl", tmp_path / "quiet.jsonl")
    assert done.code == 0 and all("WARNING: " in line for line in done.err.splitlines())
    done = run(*command, "--jsonl", "-", "--gnss", "watch")
    assert (done.code, done.out) == (1, "") and "gnss.csv" in done.err.splitlines()[-1]


@pytest.mark.parametrize("how", ["nobody reads", "full", "closed"])
def test_a_stderr_that_takes_nothing_delays_no_flight(flown, tmp_path, how):
    path, folder, _, _ = flown
    lines = tmp_path / "lines.jsonl"
    reader, writer = os.pipe()
    if how == "nobody reads":
        os.close(reader)
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError, BrokenPipeError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    options = ("--recorded-telemetry", "--jsonl", lines)
    command = (sys.executable, PACED, lines, tmp_path, "fly", path, folder, *options)
    script = f"exec {shlex.join(map(str, command))}{' 2>&-' if how == 'closed' else ''}"
    done = subprocess.run(["sh", "-c", script], stderr=writer, timeout=240, check=False)
    assert done.returncode == 0
    assert '"health"' in lines.read_text() and '"frame"' in lines.read_text()
    os.close(writer)
    if how != "nobody reads":
        os.close(reader)


def test_a_flight_loads_neither_torch_nor_gdal_nor_ros():
    script = (
        "import sys, orthonav.onboard.fly, orthonav.cli.fly, orthonav.core.track.tracker\n"
        "import orthonav.cli.flying\n"
        "unwanted = {'torch', 'rasterio', 'pyproj', 'pymavlink', 'mcap', 'rclpy', 'rosbags'}\n"
        "print(unwanted & {name.partition('.')[0] for name in sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"
