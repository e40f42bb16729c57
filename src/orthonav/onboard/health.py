"""Health of a flight: its level by the reasons of the monitors (docs/onboard.md)."""

import os
import socket
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum

STATUSTEXT_INTERVAL_NS = 5 * 10**9
FAILURES = (
    *("no_camera", "link_down", "no_telemetry"),
    *("wrong_camera", "map_file_changed", "internal_errors"),
)
"""Reasons for which no position can be sent."""


class Level(Enum):
    """Level of health; the value is MAV_STATE in our heartbeat."""

    OK = 4  # active
    DEGRADED = 5  # critical: there is a fault, positions may still be sent
    FAILED = 6  # emergency: no position can be sent

    @property
    def severity(self) -> int:
        return {Level.OK: 6, Level.DEGRADED: 4, Level.FAILED: 3}[self]


Monitor = Callable[[int], Iterable[str]]
"""Gives reasons of health at a time of our clock."""


@dataclass(frozen=True)
class Health:
    level: Level
    reasons: tuple[str, ...] = ()
    detail: str = field(default="", compare=False)  # of the last reason

    def text(self) -> str:
        text = f"orthonav {self.level.name}"
        text = f"{text}: {', '.join(self.reasons)}" if self.reasons else text
        return f"{text}: {self.detail}" if self.detail else text


def judge(monitors: Sequence[Monitor], now_ns: int, detail: str = "") -> Health:
    """Health by the reasons of the monitors, in their order, failures first."""
    found = [reason for monitor in monitors for reason in monitor(now_ns)]
    worst = [each for each in found if each in FAILURES]
    others = [each for each in found if each not in FAILURES]
    level = Level.FAILED if worst else Level.DEGRADED if others else Level.OK
    return Health(level, (*worst, *others), detail)


class HealthReporter:
    def __init__(self) -> None:
        self._reported: Health | None = None
        self._reported_ns: int | None = None

    def due(self, health: Health, now_ns: int) -> bool:
        if health == self._reported:
            return False
        if self._reported_ns is not None and now_ns - self._reported_ns < STATUSTEXT_INTERVAL_NS:
            return False
        self._reported, self._reported_ns = health, now_ns
        return True


def notify(*lines: str) -> bool:
    """Send `READY=1`, `WATCHDOG=1`, `STATUS=..` to systemd as `sd_notify(3)` does."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    address = "\0" + address[1:] if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto("\n".join(lines).encode(), address)
    except OSError:
        return False
    return True
