"""Health: counts become a level with reasons, which is reported."""

import math
import os
import socket
from collections import Counter
from functools import partial
from types import SimpleNamespace

import pytest
from fake_autopilot import S

from orthonav.onboard.health import Health, HealthReporter, Level, judge, notify
from orthonav.onboard.monitors import (
    EventCounter,
    TrackMonitor,
    camera_reasons,
    link_reasons,
    output_reasons,
    program_reasons,
)


class Judged:
    """All monitors of a flight, at `running_s` after its start."""

    def __init__(self, running_s=60.0, **seen):
        self.now_ns = round(running_s * S)
        self.events = EventCounter(0)
        counts = {"taken": 50, "processed": 50, "confident": 50, **seen.pop("counts", {})}
        for name in Counter(counts).elements():
            self.events.add(self.now_ns, name)
        self.events.add_latency(self.now_ns, seen.pop("latency_s", 0.1))
        ages = {name: seen.pop(f"{name}_age_s", 0.0) for name in ("heard", "attitude")}
        link = SimpleNamespace(
            sync=SimpleNamespace(is_exact=seen.pop("synced", True)),
            origin=seen.pop("origin", "known"),
            heard_age_s=ages["heard"],
            attitude_age_s=ages["attitude"],
        )
        gate = SimpleNamespace(is_unavailable=seen.pop("unavailable", False))
        publisher = SimpleNamespace(gate=gate, messenger=SimpleNamespace(needs_origin=True))
        state, change = seen.pop("state", "tracking"), seen.pop("map_change", None)
        for name, age in (("taken", "image_age_s"), ("confident", "low_confidence_s")):
            age_s = seen.pop(age, 0.0)
            self.events.last_ns[name] = 0 if math.isinf(age_s) else self.now_ns - round(age_s * S)
        self.track = TrackMonitor(self.events, publisher, lambda: state)
        self.monitors = [
            partial(camera_reasons, self.events),
            partial(link_reasons, self.events, link, False),
            partial(program_reasons, self.events, lambda: change),
            partial(output_reasons, self.events, publisher, link),
            self.track.reasons,
        ]
        assert not seen

    def health(self):
        return judge(self.monitors, self.now_ns)


def counted(**counts):
    return {"counts": counts}


FAILED = {
    "no_camera": {"image_age_s": 4.0},
    "link_down": {"heard_age_s": 6.0},
    "no_telemetry": {"attitude_age_s": 4.0},
    "wrong_camera": counted(wrong_camera=1),
    "internal_errors": counted(internal_error=30),
    "map_file_changed": {"map_change": "5 bytes instead of 9"},
}
DEGRADED = {
    "lost": {"state": "lost"},
    "searching": {"state": "searching"},
    "coasting": {"state": "coasting", "low_confidence_s": 3.0},
    "low_confidence": {"low_confidence_s": 11.0},
    "unavailable": {"low_confidence_s": 11.0, "unavailable": True},
    "frozen_image": counted(frozen=20),
    "bad_images": counted(bad_image=20),
    "telemetry_gaps": counted(no_telemetry=20),
    "camera_lost": counted(camera_lost=1),
    "clock_jumped": counted(clock_jump=1),
    "not_synchronized": {"synced": False},
    "slow_vision": counted(slow_vision=3),
    "no_origin": {"origin": None},
    "incomplete_message": counted(incomplete=3),
    "output_failed": counted(output_failed=1),
    "log_failed": counted(log_failed=1),
    "state_not_saved": counted(state_failed=1),
    "internal_error": counted(internal_error=1),
    "slow": {"latency_s": 0.6},
}


def test_without_faults_health_is_ok():
    assert Judged().health() == Health(Level.OK)


@pytest.mark.parametrize(
    ("level", "reason", "seen"),
    [
        *((Level.FAILED, *each) for each in FAILED.items()),
        *((Level.DEGRADED, *each) for each in DEGRADED.items()),
        (Level.DEGRADED, "slow", counted(late=20)),
    ],
)
def test_every_fault_has_a_reason(level, reason, seen):
    assert Judged(**seen).health() == Health(level, (reason,))


def test_reasons_of_failed_come_first():
    seen = Judged(attitude_age_s=4.0, counts={"bad_image": 20}).health()
    assert seen == Health(Level.FAILED, ("no_telemetry", "bad_images"))


def test_few_faults_are_ok():
    few = counted(frozen=5, bad_image=5, late=5, no_telemetry=5)
    assert Judged(**few).health().level is Level.OK


def test_missing_inputs_are_no_reason_right_after_the_start():
    ages = dict.fromkeys(("image_age_s", "attitude_age_s", "heard_age_s"), math.inf)
    assert Judged(2.0, **ages, synced=False).health().level is Level.OK
    old = Judged(6.0, **ages, synced=False).health()
    assert old.reasons == ("no_camera", "link_down", "no_telemetry")


def test_numbers_that_grow_are_events():
    events = EventCounter(0)
    for now_ns, total in ((0, 0), (1, 3), (2, 3), (3, 4)):
        events.follow(now_ns, {"log_failed": total})
    assert events.total == {"log_failed": 2}


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
