"""Health: counts become a level with reasons, which is reported."""

import math
import os
import socket

import pytest
from fake_autopilot import S

from orthonav.onboard.health import (
    Health,
    HealthReporter,
    Level,
    judge,
    notify,
)

COUNTS = {"taken": 50, "processed": 50, "confident": 50}


def counted(**counts):
    return {"counts": {**COUNTS, **counts}}


def judged(running_s=60.0, **seen):
    return judge(running_s, **{"counts": COUNTS, "latency_s": 0.1, **seen})


FAILED = {
    "no_camera": {"image_age_s": 4.0},
    "link_down": {"link_age_s": 6.0},
    "no_telemetry": {"telemetry_age_s": 4.0},
    "wrong_camera": counted(wrong_camera=1),
    "internal_errors": counted(internal_error=30),
    "map_file_changed": {"map_intact": False},
}
DEGRADED = {
    "heading_mismatch": {"mismatch": (-170.0, 0.0)},
    "height_mismatch": {"mismatch": (0.0, math.log(0.5))},
    "lost": {"state": "lost"},
    "searching": {"state": "searching"},
    "low_confidence": {"low_confidence_s": 11.0},
    "frozen_image": counted(frozen=20),
    "bad_images": counted(bad_image=20),
    "telemetry_gaps": counted(no_telemetry=20),
    "camera_lost": counted(camera_lost=1),
    "clock_jumped": counted(clock_jump=1),
    "not_synchronized": {"synced": False},
    "slow_vision": counted(slow_vision=3),
    "no_origin": {"has_origin": False},
    "incomplete_message": counted(incomplete=3),
    "output_failed": counted(output_failed=1),
    "log_failed": counted(log_failed=1),
    "state_not_saved": counted(state_failed=1),
    "internal_error": counted(internal_error=1),
    "slow": {"latency_s": 0.6},
}


def test_without_faults_health_is_ok():
    assert judged() == Health(Level.OK)


@pytest.mark.parametrize(
    ("level", "reason", "seen"),
    [
        *((Level.FAILED, *each) for each in FAILED.items()),
        *((Level.DEGRADED, *each) for each in DEGRADED.items()),
        (Level.DEGRADED, "slow", counted(late=20)),
    ],
)
def test_every_fault_has_a_reason(level, reason, seen):
    assert judged(**seen) == Health(level, (reason,))


def test_reasons_of_failed_come_first():
    seen = judged(image_age_s=4.0, state="lost")
    assert seen == Health(Level.FAILED, ("no_camera", "lost"))


def test_few_faults_are_ok():
    few = counted(frozen=5, bad_image=5, late=5, no_telemetry=5)
    assert judged(**few).level is Level.OK


def test_missing_inputs_are_no_reason_right_after_the_start():
    missing = {"image_age_s": 9.0, "telemetry_age_s": math.inf, "link_age_s": math.inf}
    assert judged(2.0, **missing, synced=False).level is Level.OK
    old = judged(6.0, **missing, synced=False)
    assert old.reasons == ("no_camera", "link_down", "no_telemetry")


def test_changes_are_reported_at_most_every_five_seconds():
    reporter, good, bad = HealthReporter(), Health(Level.OK), Health(Level.DEGRADED, ("lost",))
    reported = [
        (second, health.level.name)
        for second in range(20)
        if reporter.due(health := bad if second in (1, 3, 4) or second > 11 else good, second * S)
    ]
    assert reported == [(0, "OK"), (12, "DEGRADED")]


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_is_notified(tmp_path, abstract, monkeypatch):
    name = f"@orthonav-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.settimeout(60)
        receiver.bind(name.replace("@", "\0"))
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        assert notify("READY=1", "STATUS=flying")
        assert receiver.recv(100) == b"READY=1\nSTATUS=flying"
    assert not notify("WATCHDOG=1")  # the socket is closed
    monkeypatch.delenv("NOTIFY_SOCKET")
    assert not notify("WATCHDOG=1")
