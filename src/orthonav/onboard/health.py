"""How the flight is going: OK, DEGRADED or FAILED with reasons, and whom that is told.

`judge` is a pure function of what was counted over the last seconds. The reasons are listed in
docs/onboard.md, with what brings each about.
"""

import logging
import math
import os
import socket
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from types import MappingProxyType

import numpy as np

from orthonav.localizer.localizer import Localizer
from orthonav.records import Fix, Telemetry, View

log = logging.getLogger(__name__)
WINDOW_S = 10.0
STATUSTEXT_MAX = 50
STATUSTEXT_INTERVAL_NS = 5 * 10**9
LOOK_AFTER_S = 5.0
NOTE_S = 30.0
"""How long what a second look found is believed."""


class Level(Enum):
    """How bad it is; the value is MAV_STATE of our heartbeat."""

    OK = 4  # active
    DEGRADED = 5  # critical: something is wrong, positions may still come
    FAILED = 6  # emergency: no position can come

    @property
    def severity(self) -> int:
        """MAV_SEVERITY of the text that tells it."""
        return {Level.OK: 6, Level.DEGRADED: 4, Level.FAILED: 3}[self]


@dataclass(frozen=True)
class Health:
    """A level and its reasons, the worst first."""

    level: Level
    reasons: tuple[str, ...] = ()

    def text(self) -> str:
        """As a ground station shows it, cut off at what STATUSTEXT holds."""
        told = f"orthonav {self.level.name}"
        if self.reasons:
            told += ": " + ", ".join(self.reasons)
        return told if len(told) <= STATUSTEXT_MAX else told[: STATUSTEXT_MAX - 2] + ".."


@dataclass(frozen=True)
class HealthLimits:
    """From when on something is wrong."""

    picture_age_s: float = 3.0
    telemetry_age_s: float = 3.0
    link_age_s: float = 5.0
    low_confidence_s: float = 10.0
    latency_s: float = 0.5
    share: float = 0.2
    """Share of the pictures in the window that may be unusable, late, or without telemetry."""
    heading_deg: float = 20.0
    log_scale: float = 0.2
    grace_s: float = 5.0
    """After the start nothing is missed for so long."""


@dataclass(frozen=True)
class Snapshot:
    """What `judge` is told: counts within the window, ages in seconds (infinite: never).

    `counts` by name: `taken` (looked at by the runner), `processed`, `late`, `frozen`,
    `bad_picture`, `no_telemetry`, `internal_error`, `wrong_camera`, `camera_lost`,
    `clock_jump`, `output_failed`, `log_failed`, `state_failed`. `heading_off_deg` and
    `log_scale_off` are how far the last sure fix lies from what was told.
    """

    running_s: float
    counts: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    picture_age_s: float = 0.0
    telemetry_age_s: float = 0.0
    link_age_s: float = 0.0
    low_confidence_s: float = 0.0
    latency_s: float = 0.0
    state: str | None = "tracking"
    synced: bool = True
    map_there: bool = True
    heading_off_deg: float = 0.0
    log_scale_off: float = 0.0


def judge(seen: Snapshot, limits: HealthLimits | None = None) -> Health:
    """The level and its reasons."""
    limits = limits or HealthLimits()
    count = Counter(seen.counts)
    many = limits.share * max(count["taken"], 1)
    settled = seen.running_s > limits.grace_s
    failed = {
        "no_camera": settled and seen.picture_age_s > limits.picture_age_s,
        "link_down": settled and seen.link_age_s > limits.link_age_s,
        "no_telemetry": settled and seen.telemetry_age_s > limits.telemetry_age_s,
        "wrong_camera": count["wrong_camera"] > 0,
        "internal_errors": count["internal_error"] > 0.5 * max(count["processed"], 1),
    }
    degraded = {
        "heading_off": abs(seen.heading_off_deg) > limits.heading_deg,
        "height_off": abs(seen.log_scale_off) > limits.log_scale,
        "lost": seen.state == "lost",
        "searching": seen.state == "searching",
        "unsure": seen.state not in ("lost", "searching")
        and seen.low_confidence_s > limits.low_confidence_s,
        "frozen_picture": count["frozen"] > many,
        "bad_pictures": count["bad_picture"] > many,
        "telemetry_gaps": count["no_telemetry"] > many and not failed["no_telemetry"],
        "slow": seen.latency_s > limits.latency_s or count["late"] > many,
        "camera_lost": count["camera_lost"] > 0 and not failed["no_camera"],
        "clock_jumped": count["clock_jump"] > 0,
        "unsynced": settled and not seen.synced and not failed["link_down"],
        "map_gone": not seen.map_there,
        "output_failed": count["output_failed"] > 0,
        "log_failed": count["log_failed"] > 0,
        "state_not_saved": count["state_failed"] > 0,
        "internal_error": count["internal_error"] > 0 and not failed["internal_errors"],
    }
    worst = tuple(name for name, applies in failed.items() if applies)
    others = tuple(name for name, applies in degraded.items() if applies)
    level = Level.FAILED if worst else Level.DEGRADED if others else Level.OK
    return Health(level, worst + others)


class Tally:
    """Counts what happened within the last seconds. Mutable."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._events: deque[tuple[int, str]] = deque()
        self._latencies: deque[tuple[int, float]] = deque()
        self._counts: Counter[str] = Counter()
        self.total: Counter[str] = Counter()

    def add(self, now_ns: int, name: str) -> None:
        """Something happened."""
        self._events.append((now_ns, name))
        self._counts[name] += 1
        self.total[name] += 1

    def add_latency(self, now_ns: int, seconds: float) -> None:
        """A view took so long from exposure to the end."""
        self._latencies.append((now_ns, seconds))

    def counts(self, now_ns: int) -> Counter[str]:
        """By name, within the window."""
        begin = now_ns - self._window_ns
        while self._events and self._events[0][0] < begin:
            self._counts[self._events.popleft()[1]] -= 1
        while self._latencies and self._latencies[0][0] < begin:
            self._latencies.popleft()
        return Counter(+self._counts)

    def latency_s(self, quantile: float) -> float:
        """A quantile of the latencies in the window, 0 without any."""
        values = [seconds for _, seconds in self._latencies]
        return float(np.quantile(values, quantile)) if values else 0.0


class Teller:
    """Decides when a change of health is told as a text: at most one in five seconds. Mutable."""

    def __init__(self) -> None:
        self._told: Health | None = None
        self._told_ns: int | None = None

    def due(self, health: Health, now_ns: int) -> bool:
        """Whether to tell it now."""
        if health == self._told:
            return False
        if self._told_ns is not None and now_ns - self._told_ns < STATUSTEXT_INTERVAL_NS:
            return False
        self._told, self._told_ns = health, now_ns
        return True


class Notifier:
    """Tells systemd that we live: datagrams to the socket it names (sd_notify)."""

    def __init__(self, address: str | None = None) -> None:
        """`address` is by default that of the environment; without any nothing is told."""
        address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + address[1:] if address.startswith("@") else address

    def tell(self, *lines: str) -> bool:
        """Lines such as `READY=1`, `WATCHDOG=1`, `STATUS=..`; whether they went out."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
                out.setblocking(False)
                out.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            return False
        return True


def offsets(fix: Fix, told: Telemetry) -> tuple[float, float]:
    """How far a fix's heading (degrees) and height (natural logarithm) lie from what was told."""
    heading = (fix.heading_deg - told.yaw_deg + 180.0) % 360.0 - 180.0
    known = fix.agl_m > 0 and told.agl_m > 0
    scale = math.log(fix.agl_m / told.agl_m) if known else 0.0
    return (heading if math.isfinite(heading) else 0.0), scale


class SecondLook:
    """Why is nothing found? Looks as if heading or height were told wrong, one guess at a time.

    While a track searches in vain: any heading, half the height, twice the height. What is found
    with confidence says what is wrong; it is no position that is flown by. On a large map a look
    takes seconds, so it is taken beside the flight, one at a time. Mutable.
    """

    GUESSES = ((False, 1.0), (True, 0.5), (True, 2.0))  # heading known, share of the height

    def __init__(
        self,
        localizer: Localizer,
        min_confidence: float,
        beside: Callable[[Callable[[], None]], None] | None = None,
    ) -> None:
        """`beside` runs what it is given, by default in a thread."""
        self._localizer, self._least = localizer, min_confidence
        self._beside = beside or _in_a_thread
        self._busy = False
        self._since_ns: int | None = None
        self._number = 0
        self._found: tuple[int, float, float] | None = None

    def look(self, view: View, found: bool, now_ns: int) -> None:
        """Hand in every view and whether the track has a place; now and then one is looked at."""
        if found or self._since_ns is None:
            self._since_ns = now_ns
            self._found = None if found else self._found
            return
        if self._busy or now_ns - self._since_ns < LOOK_AFTER_S * 1e9:
            return
        self._since_ns = now_ns
        heading_known, share = self.GUESSES[self._number % len(self.GUESSES)]
        self._number += 1
        told = view.telemetry
        guess = replace(view, telemetry=replace(told, agl_m=told.agl_m * share))

        def look() -> None:
            try:
                seen = self._localizer.locate(guess, heading_known=heading_known)
                if isinstance(seen, Fix) and seen.confidence >= self._least:
                    self._found = (now_ns, *offsets(seen, told))
            except Exception:  # nothing depends on it
                log.exception("second look")
            finally:
                self._busy = False

        self._busy = True
        self._beside(look)

    def offsets(self, now_ns: int) -> tuple[float, float]:
        """What was found wrong lately with heading (degrees) and height (logarithm); else 0."""
        if self._found is None or now_ns - self._found[0] > NOTE_S * 1e9:
            return 0.0, 0.0
        return self._found[1:]


def _in_a_thread(work: Callable[[], None]) -> None:
    threading.Thread(target=work, name="second look", daemon=True).start()
