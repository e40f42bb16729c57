"""Health: what is counted becomes a level with reasons, and somebody hears of it."""

import math
import os
import socket
from dataclasses import replace

import numpy as np
import pytest
from fake_autopilot import S, fix

from orthonav.geo.camera import Camera
from orthonav.onboard.health import (
    LOOK_AFTER_S,
    NOTE_S,
    STATUSTEXT_MAX,
    Health,
    Level,
    Notifier,
    SecondLook,
    Snapshot,
    Tally,
    Teller,
    judge,
    offsets,
)
from orthonav.records import NoFix, Telemetry, View

GOOD = Snapshot(60.0, {"taken": 50, "processed": 50, "sure": 50}, latency_s=0.1)
CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
TOLD = Telemetry(0, 10.0, 0.0, 0.0, 100.0)


def counted(**counts):
    return replace(GOOD, counts={**GOOD.counts, **counts})


FAULTS = {
    "no_camera": (replace(GOOD, picture_age_s=4.0), Level.FAILED),
    "link_down": (replace(GOOD, link_age_s=6.0), Level.FAILED),
    "no_telemetry": (replace(GOOD, telemetry_age_s=4.0), Level.FAILED),
    "wrong_camera": (counted(wrong_camera=1), Level.FAILED),
    "internal_errors": (counted(internal_error=30), Level.FAILED),
    "heading_off": (replace(GOOD, heading_off_deg=-170.0), Level.DEGRADED),
    "height_off": (replace(GOOD, log_scale_off=math.log(0.5)), Level.DEGRADED),
    "lost": (replace(GOOD, state="lost"), Level.DEGRADED),
    "searching": (replace(GOOD, state="searching"), Level.DEGRADED),
    "unsure": (replace(GOOD, low_confidence_s=11.0), Level.DEGRADED),
    "frozen_picture": (counted(frozen=20), Level.DEGRADED),
    "bad_pictures": (counted(bad_picture=20), Level.DEGRADED),
    "telemetry_gaps": (counted(no_telemetry=20), Level.DEGRADED),
    "camera_lost": (counted(camera_lost=1), Level.DEGRADED),
    "clock_jumped": (counted(clock_jump=1), Level.DEGRADED),
    "unsynced": (replace(GOOD, synced=False), Level.DEGRADED),
    "map_gone": (replace(GOOD, map_there=False), Level.DEGRADED),
    "output_failed": (counted(output_failed=1), Level.DEGRADED),
    "log_failed": (counted(log_failed=1), Level.DEGRADED),
    "state_not_saved": (counted(state_failed=1), Level.DEGRADED),
    "internal_error": (counted(internal_error=1), Level.DEGRADED),
}


def test_all_is_well():
    assert judge(GOOD) == Health(Level.OK)


@pytest.mark.parametrize("reason", FAULTS)
def test_every_fault_has_a_reason(reason):
    seen, level = FAULTS[reason]
    assert judge(seen) == Health(level, (reason,))


@pytest.mark.parametrize("seen", [replace(GOOD, latency_s=0.6), counted(late=20)])
def test_a_starved_processor_is_told(seen):
    assert judge(seen) == Health(Level.DEGRADED, ("slow",))


def test_the_worst_comes_first():
    seen = replace(FAULTS["no_camera"][0], state="lost", map_there=False)
    assert judge(seen) == Health(Level.FAILED, ("no_camera", "lost", "map_gone"))


def test_a_little_is_forgiven():
    assert judge(counted(frozen=5, bad_picture=5, late=5, no_telemetry=5)).level is Level.OK


def test_at_the_start_nothing_is_missed_yet():
    young = replace(GOOD, running_s=2.0, picture_age_s=9.0, telemetry_age_s=math.inf)
    young = replace(young, link_age_s=math.inf, synced=False)
    assert judge(young).level is Level.OK
    old = judge(replace(young, running_s=6.0))
    assert old.reasons == ("no_camera", "link_down", "no_telemetry")


def test_texts_fit_a_statustext():
    assert Health(Level.OK).text() == "orthonav OK"
    every = Health(Level.FAILED, tuple(FAULTS)).text()
    assert len(every) == STATUSTEXT_MAX and every.startswith("orthonav FAILED: no_camera, ")


def test_changes_are_told_at_most_every_five_seconds():
    teller, good, bad = Teller(), Health(Level.OK), Health(Level.DEGRADED, ("lost",))
    telemetry = [
        (second, health.level.name)
        for second in range(20)
        if teller.due(health := bad if second in (1, 3, 4) or second > 11 else good, second * S)
    ]
    assert telemetry == [(0, "OK"), (12, "DEGRADED")]


def test_counts_are_those_of_the_window():
    tally = Tally(10.0)
    for second in range(20):
        tally.add(second * S, "late")
        tally.add_latency(second * S, second / 10)
    assert tally.counts(19 * S) == {"late": 11} and tally.total == {"late": 20}
    assert tally.latency_s(0.5) == pytest.approx(1.4)
    assert tally.counts(99 * S) == {} and tally.latency_s(0.5) == 0.0


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_is_told(tmp_path, abstract, monkeypatch):
    name = f"@orthonav-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.settimeout(2)
        heard.bind(name.replace("@", "\0"))
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        assert Notifier().tell("READY=1", "STATUS=flying")
        assert heard.recv(100) == b"READY=1\nSTATUS=flying"
    assert not Notifier().tell("WATCHDOG=1")  # it went away
    monkeypatch.delenv("NOTIFY_SOCKET")
    assert not Notifier().tell("WATCHDOG=1")


def test_offsets_go_the_short_way_round():
    assert offsets(fix(heading_deg=350.0, agl_m=200.0), TOLD) == (-20.0, math.log(2))
    assert offsets(fix(), replace(TOLD, yaw_deg=math.nan))[0] == 0.0
    assert offsets(fix(), replace(TOLD, agl_m=math.nan))[1] == 0.0


def at_once(work):
    work()


class Guessing:
    """A localizer that finds the place only where heading and height are right."""

    def __init__(self, heading_deg=10.0, agl_m=100.0):
        self.heading_deg, self.agl_m, self.asked = heading_deg, agl_m, []

    def locate(self, view, *, heading_known):
        telemetry = view.telemetry
        self.asked.append((heading_known, telemetry.agl_m))
        right = not heading_known or abs(telemetry.yaw_deg - self.heading_deg) < 20
        if right and 0.8 < telemetry.agl_m / self.agl_m < 1.25:
            return fix(heading_deg=self.heading_deg, agl_m=self.agl_m)
        return NoFix("low_confidence", "")


@pytest.mark.parametrize(
    ("heading", "height", "off"),
    [(190.0, 100.0, (180.0, 0.0)), (10.0, 50.0, (0.0, -math.log(2))), (10.0, 200.0, (0, 0.693))],
)
def test_a_second_look_says_what_is_told_wrong(heading, height, off):
    second, grey = (
        SecondLook(Guessing(heading, height), 0.9, at_once),
        np.zeros((240, 320), np.uint8),
    )
    for number in range(int(4 * LOOK_AFTER_S)):
        second.look(View(grey, CAMERA, TOLD), False, number * S)
    found = second.offsets(number * S)
    assert (abs(found[0]), found[1]) == pytest.approx(off, abs=1e-3)
    assert second.offsets(round((number + NOTE_S + LOOK_AFTER_S) * S)) == (0.0, 0.0)


def test_nobody_looks_twice_while_all_is_well():
    guessing = Guessing()
    second, grey = SecondLook(guessing, 0.9, at_once), np.zeros((240, 320), np.uint8)
    for number in range(100):
        second.look(View(grey, CAMERA, TOLD), number % 4 != 0, number * S)
    assert guessing.asked == [] and second.offsets(100 * S) == (0.0, 0.0)
    for number in range(100, 118):
        second.look(View(grey, CAMERA, replace(TOLD, agl_m=300.0)), False, number * S)
    assert guessing.asked == [(False, 300.0), (True, 150.0), (True, 600.0)]
