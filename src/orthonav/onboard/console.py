"""What `orthonav fly` says while it flies: inputs, states of the track, faults, a status line every
few seconds, a summary. It is an output of `Publisher`, like the lines of JSON."""

import contextlib
import logging
import math
import os
import queue
import sys
import threading
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TextIO

import numpy as np

from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.onboard.cameras import NewestImage
from orthonav.onboard.health import STATUSTEXT_INTERVAL_NS, Level
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.gate import unavailable_text
from orthonav.onboard.messages.mavlink import Autopilot
from orthonav.onboard.telemetry import Clocks

TERMINAL_S, FILE_S = 5.0, 30.0
"""Interval of the status line on a terminal, and elsewhere."""
REMIND_S = 10.0
"""Interval of lines about a missing input."""
_MOST_AGES = 100_000
_KINDS = {Autopilot.PX4: " PX4", Autopilot.ARDUPILOT: " ArduPilot", None: ""}
_STATES = {
    "searching": "no place has been recognized yet",
    "coasting": "views do not show the map; the position is dead reckoned",
    "lost": "the track does not fit the map any more",
}
_FAULTS = {
    "no_camera": "no image",
    "link_down": "no message from the autopilot",
    "no_telemetry": "no attitude; set the stream rates of the autopilot",
    "wrong_camera": "images do not fit --camera",
    "heading_mismatch": "check the compass and --mount-deg, or use --heading unknown",
    "height_mismatch": "check --height and the focal length",
    "start_mismatch": "the ground contradicts the start position",
    "not_synchronized": "TIMESYNC is not answered",
    "no_origin": "the autopilot has no local origin; give --origin on the ground",
    "slow": "positions are late; see --budget-ms and --threads",
}
"""What a reason of the health means, where its name does not say so."""
MOST_LINES = 1000
"""Lines that wait for a slow reader; later ones are dropped."""
CLOSE_S = 1.0
"""Longest time that the last lines may take at the end."""


class Console:
    """Takes lines and never blocks. Thread-safe. `quiet`: warnings only."""

    def __init__(self, stream: TextIO | None, clocks: Clocks, *, quiet: bool = False) -> None:
        self._clocks, self.quiet = clocks, quiet
        self._begun_ns = clocks.mono_ns()
        self._lines: queue.Queue[str | None] = queue.Queue(MOST_LINES)
        descriptor = _descriptor(stream)
        self.is_open = descriptor is not None
        self.is_terminal = descriptor is not None and os.isatty(descriptor)
        self._thread = threading.Thread(
            target=self._write, args=(descriptor,), name="console", daemon=True
        )
        self._thread.start()

    def say(self, text: str) -> None:
        if not self.quiet:
            self.put(text)

    def warn(self, text: str) -> None:
        self.put(f"WARNING: {text}")

    def put(self, text: str) -> None:
        seconds = (self._clocks.mono_ns() - self._begun_ns) / 1e9
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(f"{seconds:8.1f} s  {text}\n")

    def write(self, text: str) -> None:
        """As a stream of log records, which end with their line."""
        self.put(text.rstrip("\n"))

    def close(self) -> None:
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(CLOSE_S)

    @contextlib.contextmanager
    def in_place_of_stderr(self) -> Iterator[None]:
        """Write log records meanwhile which otherwise go to stderr, at least warnings."""
        root, streams = logging.getLogger(), []
        level = root.level
        for handler in root.handlers if self.is_open else ():
            if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stderr:
                handler.setStream(self)
                streams.append(handler)
        if self.is_open:
            root.setLevel(min(level, logging.WARNING))
        try:
            yield
        finally:
            root.setLevel(level)
            for handler in streams:
                handler.setStream(sys.stderr)

    def _write(self, descriptor: int | None) -> None:
        # Not by the stream: a thread that holds its lock at the end would abort the interpreter.
        while (line := self._lines.get()) is not None:
            data = line.encode("utf-8", "backslashreplace")
            with contextlib.suppress(OSError):  # nobody reads any more, or a full disk
                while descriptor is not None and data:
                    data = data[os.write(descriptor, data) :]


class Narrator:
    def __init__(
        self,
        console: Console,
        clocks: Clocks,
        newest: NewestImage,
        images: str | None,
        link: AutopilotLink | None,
        url: str | None,
        *,
        sends: bool,
    ) -> None:
        """`images`: where they come from; None: their source says what it waits for. `sends`:
        positions, to an autopilot or to ROS 2."""
        self._console, self._clocks, self._sends = console, clocks, sends
        self._newest, self._images, self._link, self._url = newest, images, link, url
        self._interval_ns = round((TERMINAL_S if console.is_terminal else FILE_S) * 1e9)
        self._status_ns = clocks.mono_ns() + self._interval_ns
        self._reminded: dict[str, int] = {}
        self._heard: set[str] = set()
        self._faults: tuple[str, ...] = ()
        self._faults_ns, self._is_faulty = 0, False
        self._result: ViewResult | None = None
        self._counts, self._before = Counter[str](), Counter[str]()
        self._explained: set[str] = set()
        self._meant: set[str] = set()
        self._ages_ms: deque[float] = deque(maxlen=_MOST_AGES)
        self._begun_ns: int | None = None
        self._first_s: float | None = None
        self._dropped = 0

    def view(
        self, result: ViewResult, age_ms: float, sent: Sequence[str], withheld: str | None
    ) -> None:
        now_ns = self._clocks.mono_ns()
        self._watch(now_ns)
        self._begun_ns = self._begun_ns or now_ns
        reason = self._reason(result, sent, withheld)
        self._counts["views"] += 1
        self._counts["" if reason is None else f"withheld {reason}"] += 1
        if math.isfinite(result.latency_ms):
            self._ages_ms.append(age_ms)
        if reason is None and self._first_s is None:
            self._first_s = (now_ns - self._begun_ns) / 1e9
        self._explain(result)
        before, self._result = self._result, result
        if before is None or before.state != result.state:
            self._say_state(None if before is None else before.state, result)

    def health(self, plain: Mapping[str, Any]) -> None:
        now_ns = self._clocks.mono_ns()
        self._watch(now_ns)
        self._say_faults(plain, now_ns)
        counts = plain["counts"]
        self._dropped = counts.get("late", 0) + counts.get("replaced", 0)
        if now_ns >= self._status_ns:
            self._status_ns = now_ns + self._interval_ns
            self._console.say(self._status(plain))

    def close(self) -> None:
        self._console.say(self._summary())

    def _reason(self, result: ViewResult, sent: Sequence[str], withheld: str | None) -> str | None:
        if sent:
            return None
        if isinstance(result.outcome, NoFix) and withheld in (None, "no_fix"):
            return result.outcome.reason
        return withheld or ("not_sent" if self._sends else None)

    def _explain(self, result: ViewResult) -> None:
        outcome = result.outcome
        if isinstance(outcome, NoFix) and outcome.reason not in {*self._explained, "searching"}:
            self._explained.add(outcome.reason)
            self._console.say(f"view {result.frame}: {outcome.reason}: {outcome.detail}")

    def _say_state(self, before: str | None, now: ViewResult) -> None:
        change = f"{before} -> {now.state}" if before else f"{now.state}"
        text = _STATES.get(now.state or "") or _place_text(now.outcome)
        say = self._console.warn if before == "tracking" else self._console.say
        say(f"{change}: {text}")

    def _watch(self, now_ns: int) -> None:
        if self._link is not None:
            self._remind(self._missing_of(self._link), now_ns)
        problem = self._newest.problem
        images = f"images; {problem}" if self._images and problem else self._images
        self._remind(None if self._newest.taken else images, now_ns)

    def _missing_of(self, link: AutopilotLink) -> str | None:
        """What is waited for from the autopilot; None where telemetry came."""
        for each in list(link.others):
            self._say_heard(f"{each.system_id}/{each.component_id}", ", not used (see --system-id)")
        if link.target is None:
            why = "" if link.is_open else ", which cannot be opened"
            if link.counts["damaged"]:
                why += "; messages are damaged, or not signed with this key"
            return f"heartbeat on {self._url}{why}"
        ids = f"{link.target.system_id}/{link.target.component_id}"
        self._say_heard(f"{ids}{_KINDS[link.kind]}", "")
        return None if math.isfinite(link.attitude_age_s) else f"ATTITUDE of autopilot {ids}"

    def _say_heard(self, name: str, use: str) -> None:
        if name not in self._heard:
            self._heard.add(name)
            self._console.say(f"autopilot {name} heard on {self._url}{use}")

    def _remind(self, waits: str | None, now_ns: int) -> None:
        if waits is not None and now_ns >= self._reminded.get(waits, now_ns):
            self._reminded[waits] = now_ns + round(REMIND_S * 1e9)
            self._console.say(f"waiting for {waits}")

    def _say_faults(self, plain: Mapping[str, Any], now_ns: int) -> None:
        shown = tuple(each for each in plain["reasons"] if each not in _STATES)
        if self._is_faulty and plain["health"] == Level.OK.name:
            self._is_faulty = False
            self._console.say("health OK")
        is_new = not self._meant.issuperset(shown)
        if shown == self._faults or not (is_new or now_ns >= self._faults_ns):
            return
        self._faults, self._faults_ns = shown, now_ns + STATUSTEXT_INTERVAL_NS
        self._is_faulty |= bool(shown)
        if shown:
            self._console.warn(f"{plain['health']}: {', '.join(self._fault(plain, shown))}")

    def _fault(self, plain: Mapping[str, Any], shown: Sequence[str]) -> Iterator[str]:
        for reason in shown:
            is_told = reason in self._meant and reason != "unavailable"  # its figures change
            meaning = "" if is_told else _meaning(reason, plain)
            self._meant.add(reason)
            yield f"{reason} ({meaning})" if meaning else reason

    def _status(self, plain: Mapping[str, Any]) -> str:
        since = self._counts - self._before
        self._before = self._counts.copy()
        if self._result is None:
            return f"no view yet; health {plain['health']}"
        outcome, is_place = self._result.outcome, self._result.state in ("tracking", "coasting")
        place = f" {_place_text(outcome)}" if is_place and isinstance(outcome, Fix) else ""
        parts = [f"{plain['state']}{place}", _counted(since, self._sends)]
        if plain["age_p50_ms"]:
            parts.append(f"latency {plain['age_p50_ms']:.0f} ms, p95 {plain['age_p95_ms']:.0f} ms")
        unavailable = unavailable_text(plain)
        parts += [f"unavailable: {unavailable}"] if unavailable else []
        return "; ".join([*parts, f"health {plain['health']}"])

    def _summary(self) -> str:
        parts = [_counted(self._counts, self._sends)]
        if self._dropped:
            parts.append(f"images dropped as too late: {self._dropped}")
        if self._ages_ms:
            median, p99 = np.percentile(list(self._ages_ms), [50, 99])
            parts.append(f"latency median {median:.0f} ms, p99 {p99:.0f} ms")
        if self._first_s is not None:
            parts.append(f"first position {self._first_s:.1f} s after the first view")
        elif self._counts["views"]:
            parts.append("no position in the whole flight")
        return "end: " + "; ".join(parts)


def _meaning(reason: str, plain: Mapping[str, Any]) -> str:
    if reason == "start_mismatch":
        return f"{_FAULTS[reason]}, {plain['start_off_m']:,.0f} m from the place found"
    if reason == "unavailable":
        return unavailable_text(plain)
    of_camera = str(plain.get("latency"))
    if of_camera.startswith(f"{reason}: "):
        return of_camera.removeprefix(f"{reason}: ")
    return _FAULTS.get(reason, "")


def _place_text(outcome: Fix | NoFix) -> str:
    if isinstance(outcome, NoFix):
        return f"{outcome.reason}: {outcome.detail}"
    return f"{outcome.lat_deg:.6f}, {outcome.lon_deg:.6f} +- {outcome.std_m:.1f} m"


def _counted(counts: Counter[str], sends: bool) -> str:
    reasons = {name[9:]: n for name, n in counts.most_common() if name.startswith("withheld ")}
    good = f"{counts['']} sent" if sends else f"{counts['']} with a position (none is sent)"
    text = f"{counts['views']} view{'' if counts['views'] == 1 else 's'}, {good}"
    if not reasons:
        return text
    named = ", ".join(f"{name} {number}" for name, number in reasons.items())
    return f"{text}, {sum(reasons.values())} withheld: {named}"


def _descriptor(stream: TextIO | None) -> int | None:
    try:
        return None if stream is None else stream.fileno()
    except (OSError, ValueError):  # closed, or replaced by an object in memory
        return None
