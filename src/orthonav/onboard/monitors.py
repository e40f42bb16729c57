"""Monitors of a flight: each gives the reasons of health that it sees (docs/onboard.md)."""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Prior, Telemetry
from orthonav.core.track.filter import usual_velocity_std_mps
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.outputs import Publisher
from orthonav.onboard.state import SPEED_MPS


@dataclass(frozen=True)
class HealthLimits:
    """From where on what is observed is a reason of health (docs/onboard.md)."""

    window_s: float = 10.0  # events of so many seconds count
    settled_s: float = 5.0  # after the start, in which missing inputs are no reason
    share: float = 0.2
    """Fraction of images unusable, late or without telemetry, and of seconds with incomplete or
    slow messages."""
    error_share: float = 0.5  # of processed images, with an internal error
    image_age_s: float = 3.0  # without an image: beyond this a camera counts as missing
    link_age_s: float = 5.0  # without a message: several heartbeats, which come once a second
    telemetry_age_s: float = 3.0  # without an attitude
    heading_deg: float = 20.0  # estimated less reported heading
    log_scale: float = 0.2  # logarithm of estimated over reported height: a factor of 1.22
    coasting_s: float = 2.0  # without a confident position while views do not show the map,
    low_confidence_s: float = 10.0  # and while they do
    latency_s: float = 0.5  # from exposure to message, 95th percentile
    start_sigmas: float = 3.0
    """A place farther from the start than this many deviations contradicts it,"""
    start_shown_s: float = 30.0  # which is reported for so long


LIMITS = HealthLimits()


class EventCounter:
    """Counts of events by name, and times from exposure to message. Mutable."""

    def __init__(self, begun_ns: int) -> None:
        self._begun_ns = begun_ns
        self._events: deque[tuple[int, str]] = deque()
        self._latencies: deque[tuple[int, float]] = deque()
        self._followed: Mapping[str, int] = {}
        self.last_ns: dict[str, int] = {}
        self.total: Counter[str] = Counter()

    def add(self, now_ns: int, name: str) -> None:
        self._events.append((now_ns, name))
        self.last_ns[name] = now_ns
        self.total[name] += 1

    def add_latency(self, now_ns: int, seconds: float) -> None:
        self._latencies.append((now_ns, seconds))

    def follow(self, now_ns: int, totals: Mapping[str, int]) -> None:
        """Add an event for each of these numbers that is larger than at the call before."""
        for name, total in totals.items():
            if total > self._followed.get(name, 0):
                self.add(now_ns, name)
        self._followed = totals

    def counts(self, now_ns: int) -> Counter[str]:
        begin = now_ns - round(LIMITS.window_s * 1e9)
        while self._events and self._events[0][0] < begin:
            self._events.popleft()
        while self._latencies and self._latencies[0][0] < begin:
            self._latencies.popleft()
        return Counter(name for _, name in self._events)

    def many(self, now_ns: int) -> set[str]:
        """Names of events at more than `HealthLimits.share` of the images."""
        counts = self.counts(now_ns)
        return {name for name in counts if counts[name] > LIMITS.share * max(counts["taken"], 1)}

    def latency_s(self, quantile: float) -> float:
        """Quantile (0 to 1) of the latencies within the window; 0 where there are none."""
        values = [seconds for _, seconds in self._latencies]
        return float(np.quantile(values, quantile)) if values else 0.0

    def is_settled(self, now_ns: int) -> bool:
        return now_ns - self._begun_ns > LIMITS.settled_s * 1e9

    def age_s(self, now_ns: int, name: str) -> float:
        """Time since the last such event, else since the start."""
        return (now_ns - self.last_ns.get(name, self._begun_ns)) / 1e9


def camera_reasons(events: EventCounter, now_ns: int) -> Iterator[str]:
    counts, many = events.counts(now_ns), events.many(now_ns)
    if events.is_settled(now_ns) and events.age_s(now_ns, "taken") > LIMITS.image_age_s:
        yield "no_camera"
    elif counts["camera_lost"]:
        yield "camera_lost"
    if counts["wrong_camera"]:
        yield "wrong_camera"
    if "frozen" in many:
        yield "frozen_image"
    if "bad_image" in many:
        yield "bad_images"


def link_reasons(
    events: EventCounter, link: AutopilotLink | None, recorded: bool, now_ns: int
) -> Iterator[str]:
    """Of the autopilot and its telemetry. `recorded`: that comes with the images."""
    settled = events.is_settled(now_ns)
    is_down = settled and link is not None and link.heard_age_s > LIMITS.link_age_s
    if is_down:
        yield "link_down"
    attitude_age_s = 0.0 if link is None or recorded else link.attitude_age_s
    if settled and attitude_age_s > LIMITS.telemetry_age_s:
        yield "no_telemetry"
    elif "no_telemetry" in events.many(now_ns):
        yield "telemetry_gaps"
    if events.counts(now_ns)["clock_jump"]:
        yield "clock_jumped"
    if settled and link is not None and not is_down and not link.sync.is_exact:
        yield "not_synchronized"


def program_reasons(
    events: EventCounter, map_change: Callable[[], str | None], now_ns: int
) -> Iterator[str]:
    """`map_change`: how the open map file was changed in place."""
    counts = events.counts(now_ns)
    if map_change() is not None:
        yield "map_file_changed"
    if counts["internal_error"] > LIMITS.error_share * max(counts["processed"], 1):
        yield "internal_errors"
    elif counts["internal_error"]:
        yield "internal_error"


def output_reasons(
    events: EventCounter, publisher: Publisher, link: AutopilotLink | None, now_ns: int
) -> Iterator[str]:
    counts, messenger = events.counts(now_ns), publisher.messenger
    needs_origin = messenger is not None and link is not None and messenger.needs_origin
    has_origin = not needs_origin or (link is not None and link.origin is not None)
    if events.latency_s(0.95) > LIMITS.latency_s or "late" in events.many(now_ns):
        yield "slow"
    if counts["slow_vision"] > LIMITS.share * LIMITS.window_s:
        yield "slow_vision"
    if not has_origin and events.is_settled(now_ns):
        yield "no_origin"
    if has_origin and counts["incomplete"] > LIMITS.share * LIMITS.window_s:
        yield "incomplete_message"
    for event, reason in (
        ("output_failed", "output_failed"),
        ("log_failed", "log_failed"),
        ("state_failed", "state_not_saved"),
    ):
        if counts[event]:
            yield reason


class TrackMonitor:
    """Of the track, and of what its fixes say about heading, height and start. Mutable."""

    def __init__(
        self,
        events: EventCounter,
        publisher: Publisher,
        state: Callable[[], str | None],
        *,
        heading_known: bool = True,
    ) -> None:
        self._events, self._publisher, self._state = events, publisher, state
        self._heading_known = heading_known
        self._off_deg = self._off_log_scale = 0.0
        self._start: StartCheck | None = None

    def started(self, prior: Prior | None, time_ns: int) -> None:
        self._start = None if prior is None else StartCheck(prior, time_ns)

    def moved(self, telemetry: Telemetry) -> None:
        if self._start is not None:
            self._start.moved(telemetry)

    def found(self, fix: Fix, telemetry: Telemetry, now_ns: int) -> None:
        """Compare a confident fix with the telemetry of its view."""
        if self._start is not None:
            self._start.found(fix, now_ns)
        heading_deg = (fix.heading_deg - telemetry.yaw_deg + 180.0) % 360.0 - 180.0
        is_heading_known = self._heading_known and math.isfinite(heading_deg)
        self._off_deg = heading_deg if is_heading_known else 0.0
        is_height_known = fix.agl_m > 0 and telemetry.agl_m > 0
        self._off_log_scale = math.log(fix.agl_m / telemetry.agl_m) if is_height_known else 0.0

    def start_off_m(self, now_ns: int) -> float:
        return 0.0 if self._start is None else self._start.off_m(now_ns)

    def reasons(self, now_ns: int) -> Iterator[str]:
        if abs(self._off_deg) > LIMITS.heading_deg:
            yield "heading_mismatch"
        if abs(self._off_log_scale) > LIMITS.log_scale:
            yield "height_mismatch"
        if self.start_off_m(now_ns):
            yield "start_mismatch"
        state, low_s = self._state(), self._events.age_s(now_ns, "confident")
        unavailable = self._publisher.gate.is_unavailable
        if state in ("lost", "searching") or (state == "coasting" and low_s > LIMITS.coasting_s):
            yield state
        elif state != "coasting" and low_s > LIMITS.low_confidence_s and not unavailable:
            yield "low_confidence"
        if unavailable:
            yield "unavailable"


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
        self._free_m += LIMITS.start_sigmas * std_mps * seconds

    def found(self, fix: Fix, now_ns: int) -> None:
        """Only the first place counts: later an aircraft may have come to any from the start."""
        if self._off_m is None:
            plane = LocalFrame(fix.lat_deg, fix.lon_deg)
            start_en_m = plane.en_from_latlon(self._start.lat_deg, self._start.lon_deg)
            off_m = float(np.hypot(*(start_en_m + self._moved_en_m)))
            std_m = math.hypot(self._start.std_m, fix.radius_m)
            self._off_m = off_m if off_m > LIMITS.start_sigmas * std_m + self._free_m else 0.0
            self._found_ns = now_ns

    def off_m(self, now_ns: int) -> float:
        """Distance by which the place contradicts the start; 0 within the deviations, and once it
        was shown for `start_shown_s`."""
        shown_ns = LIMITS.start_shown_s * 1e9
        return self._off_m or 0.0 if now_ns - self._found_ns < shown_ns else 0.0
