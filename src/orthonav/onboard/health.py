"""Health of a flight with reasons (docs/onboard.md)."""

import math
import os
import socket
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Prior, Telemetry
from orthonav.core.track.motion import usual_velocity_std_mps
from orthonav.onboard.state import SPEED_MPS

WINDOW_S = 10.0
"""Counts cover so many seconds."""
IMAGE_AGE_S, TELEMETRY_AGE_S, LINK_AGE_S = 3.0, 3.0, 5.0
"""Longest time without an image, an attitude, a message."""
LOW_CONFIDENCE_S, COASTING_S = 10.0, 2.0
"""Longest time without a confident position, in general and by views that do not show the map."""
LATENCY_S, SHARE = 0.5, 0.2
"""Of the 95th percentile from exposure to message; of images unusable, late, without telemetry."""
HEADING_DEG, LOG_SCALE = 20.0, 0.2
"""Difference of estimated and reported heading, and of the logarithm of the height."""
GRACE_S = 5.0
"""Missing inputs are no reason for so long after the start."""
STATUSTEXT_INTERVAL_NS = 5 * 10**9
SIGMAS = 3.0
"""A place farther from the start than this many deviations contradicts it."""
SHOWN_S = 30.0
"""Time for which a contradiction is reported."""


class Level(Enum):
    """Level of health; the value is MAV_STATE in our heartbeat."""

    OK = 4  # active
    DEGRADED = 5  # critical: there is a fault, positions may still be sent
    FAILED = 6  # emergency: no position can be sent

    @property
    def severity(self) -> int:
        return {Level.OK: 6, Level.DEGRADED: 4, Level.FAILED: 3}[self]


@dataclass(frozen=True)
class Health:
    level: Level
    reasons: tuple[str, ...] = ()
    detail: str = field(default="", compare=False)  # of the last reason

    def text(self) -> str:
        text = f"orthonav {self.level.name}"
        text = f"{text}: {', '.join(self.reasons)}" if self.reasons else text
        return f"{text}: {self.detail}" if self.detail else text


def judge(
    running_s: float,
    counts: Mapping[str, int],
    *,
    image_age_s: float = 0.0,
    telemetry_age_s: float = 0.0,
    link_age_s: float = 0.0,
    low_confidence_s: float = 0.0,
    latency_s: float = 0.0,
    state: str | None = "tracking",
    synced: bool = True,
    map_intact: bool = True,
    mismatch: tuple[float, float] = (0.0, 0.0),
    start_off_m: float = 0.0,
    gnss: Sequence[str] = (),
    has_origin: bool = True,
    latency: str | None = None,
    unavailable: str = "",
) -> Health:
    """Ages are in seconds, infinite for "never".

    `counts`: events within the window by name; `slow_vision` and `incomplete` are seconds in which
    a local message came too late for PX4 or a message could not be built. `latency_s`: 95th
    percentile from exposure to message. `map_intact`: the open file was not
    changed. `mismatch`: see there. `start_off_m`:
    distance by which the ground contradicts the start. `gnss`, `latency`: reasons of the monitors.
    `has_origin`: of the local frame, where messages need it. `unavailable`: how the alert limit is
    exceeded, "" where it is not.
    """
    count = Counter(counts)
    many = SHARE * max(count["taken"], 1)
    settled = running_s > GRACE_S
    failed = {
        "no_camera": settled and image_age_s > IMAGE_AGE_S,
        "link_down": settled and link_age_s > LINK_AGE_S,
        "no_telemetry": settled and telemetry_age_s > TELEMETRY_AGE_S,
        "wrong_camera": count["wrong_camera"] > 0,
        "map_file_changed": not map_intact,
        "internal_errors": count["internal_error"] > 0.5 * max(count["processed"], 1),
    }
    degraded = {
        "heading_mismatch": abs(mismatch[0]) > HEADING_DEG,
        "height_mismatch": abs(mismatch[1]) > LOG_SCALE,
        "start_mismatch": start_off_m > 0,
        "lost": state == "lost",
        "searching": state == "searching",
        "coasting": state == "coasting" and low_confidence_s > COASTING_S,
        "low_confidence": state not in ("lost", "searching", "coasting")
        and low_confidence_s > LOW_CONFIDENCE_S
        and not unavailable,
        "frozen_image": count["frozen"] > many,
        "bad_images": count["bad_image"] > many,
        "telemetry_gaps": count["no_telemetry"] > many and not failed["no_telemetry"],
        "slow": latency_s > LATENCY_S or count["late"] > many,
        "slow_vision": count["slow_vision"] > SHARE * WINDOW_S,
        "no_origin": settled and not has_origin,
        "incomplete_message": count["incomplete"] > SHARE * WINDOW_S and has_origin,
        "camera_lost": count["camera_lost"] > 0 and not failed["no_camera"],
        "clock_jumped": count["clock_jump"] > 0,
        "not_synchronized": settled and not synced and not failed["link_down"],
        "output_failed": count["output_failed"] > 0,
        "log_failed": count["log_failed"] > 0,
        "state_not_saved": count["state_failed"] > 0,
        "internal_error": count["internal_error"] > 0 and not failed["internal_errors"],
        **dict.fromkeys(gnss, True),
        "unavailable": bool(unavailable),
    }
    if latency is not None:
        degraded = {latency: True, **degraded}  # the cause of others, so it comes first
    worst = tuple(name for name, applies in failed.items() if applies)
    others = tuple(name for name, applies in degraded.items() if applies)
    level = Level.FAILED if worst else Level.DEGRADED if others else Level.OK
    return Health(level, worst + others, unavailable)


class EventCounter:
    def __init__(self) -> None:
        self._events: deque[tuple[int, str]] = deque()
        self._latencies: deque[tuple[int, float]] = deque()
        self.total: Counter[str] = Counter()

    def add(self, now_ns: int, name: str) -> None:
        self._events.append((now_ns, name))
        self.total[name] += 1

    def add_latency(self, now_ns: int, seconds: float) -> None:
        self._latencies.append((now_ns, seconds))

    def counts(self, now_ns: int) -> Counter[str]:
        begin = now_ns - round(WINDOW_S * 1e9)
        while self._events and self._events[0][0] < begin:
            self._events.popleft()
        while self._latencies and self._latencies[0][0] < begin:
            self._latencies.popleft()
        return Counter(name for _, name in self._events)

    def latency_s(self, quantile: float) -> float:
        """Quantile (0 to 1) of the latencies within the window; 0 where there are none."""
        values = [seconds for _, seconds in self._latencies]
        return float(np.quantile(values, quantile)) if values else 0.0


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


def mismatch(fix: Fix, telemetry: Telemetry) -> tuple[float, float]:
    """Estimated minus reported heading (degrees) and log height (natural logarithm); 0 unknown."""
    heading = (fix.heading_deg - telemetry.yaw_deg + 180.0) % 360.0 - 180.0
    known = fix.agl_m > 0 and telemetry.agl_m > 0
    scale = math.log(fix.agl_m / telemetry.agl_m) if known else 0.0
    return (heading if math.isfinite(heading) else 0.0), scale


class StartCheck:
    """Whether the first place that the track finds contradicts the start."""

    def __init__(self, start: Prior, time_ns: int) -> None:
        self._start, self._time_ns = start, time_ns
        self._moved_en_m, self._free_m = np.zeros(2), 0.0
        self._off_m: float | None = None
        self._found_ns = 0

    def moved(self, telemetry: Telemetry) -> None:
        seconds = max(telemetry.time_ns - self._time_ns, 0) / 1e9
        self._time_ns = max(telemetry.time_ns, self._time_ns)
        velocity = telemetry.vel_en_mps
        if velocity is None or not np.isfinite(velocity).all():
            self._free_m += SPEED_MPS * seconds
            return
        std_mps = telemetry.vel_std_mps or usual_velocity_std_mps(math.hypot(*velocity))
        self._moved_en_m += np.array(velocity) * seconds
        self._free_m += SIGMAS * std_mps * seconds

    def found(self, fix: Fix, now_ns: int) -> None:
        """Only the first place counts: later an aircraft may have come to any from the start."""
        if self._off_m is None:
            plane = LocalFrame(fix.lat_deg, fix.lon_deg)
            start_en_m = plane.en_from_latlon(self._start.lat_deg, self._start.lon_deg)
            off_m = float(np.hypot(*(start_en_m + self._moved_en_m)))
            std_m = math.hypot(self._start.std_m, fix.radius_m)
            self._off_m = off_m if off_m > SIGMAS * std_m + self._free_m else 0.0
            self._found_ns = now_ns

    def off_m(self, now_ns: int) -> float:
        """Distance by which the place contradicts the start; 0 within the deviations."""
        return self._off_m or 0.0 if now_ns - self._found_ns < SHOWN_S * 1e9 else 0.0
