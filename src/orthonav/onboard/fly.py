"""The runner beside an autopilot: newest picture, telemetry at its exposure, position, message.

One loop on one thread; a camera thread and a link thread feed it. Views go through
`orthonav.onboard.run.locate_view` like those of a recorded flight, so a log replays what flew.
"""

import logging
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.accept import Acceptance
from orthonav.errors import CameraError
from orthonav.flight.mount import Mount
from orthonav.geo.camera import Camera
from orthonav.localizer.checks import check_picture
from orthonav.onboard import state as states
from orthonav.onboard.cameras import FrozenCheck, Newest, Picture
from orthonav.onboard.health import (
    Health,
    Notifier,
    SecondLook,
    Snapshot,
    Tally,
    Teller,
    judge,
    offsets,
)
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.publisher import Publisher
from orthonav.onboard.run import Locator, locate_view
from orthonav.onboard.telemetry import Clocks, Told
from orthonav.publish.estimate import error_ellipse
from orthonav.publish.mavlink import dialect
from orthonav.records import CONFIDENT, Fix, NoFix, Prior, Telemetry, View, ViewResult
from orthonav.sources.attitude import LOOKS_DOWN, Angles
from orthonav.sources.recording import fitted

log = logging.getLogger(__name__)
TICK_NS = 10**9
UTC_JUMP_NS = 200_000_000
_WAIT_S = 0.001
Grey = NDArray[np.uint8]


class LogSink(Protocol):
    """What keeps a flight. Whatever it raises, the flight goes on and its health says so."""

    @property
    def lost(self) -> Mapping[str, int]:
        """How much could not be kept, by kind."""

    def options(self, told: dict[str, Any]) -> None:
        """How it was started."""

    def view(self, number: int, frame: str, grey: Grey, telemetry: Telemetry) -> None:
        """A view and exactly what is told of it, before it is placed."""

    def result(self, result: ViewResult) -> None:
        """What came out of a picture."""

    def health(self, told: dict[str, Any]) -> None:
        """How the flight is going."""

    def gnss(self, time_ns: int, cdr: bytes) -> None:
        """A `sensor_msgs/NavSatFix` of a GNSS receiver, as it was received."""

    def close(self) -> None:
        """The flight is over."""


@dataclass(frozen=True)
class FlyOptions:
    """How views are taken.

    `mount_deg`: yaw, pitch, roll of the camera in the body; `mount`: what calibration found, for
    second looks (the locator corrects by itself). `deadline_s`: older views are dropped.
    `telemetry_wait_s`: how long a view waits for the telemetry after its exposure. `recorded`:
    telemetry comes with the picture, from a recording or from ROS. `accept`: a criterion beside the
    gate's. `map_path`, `state_path`: files to look after.
    """

    mount_deg: Angles = LOOKS_DOWN
    mount: Mount | None = None
    heading_known: bool = True
    deadline_s: float = 0.5
    telemetry_wait_s: float = 0.15
    recorded: bool = False
    accept: Acceptance | None = None
    min_confidence: float = CONFIDENT
    map_path: Path | None = None
    state_path: Path | None = None
    told: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


class Runner:
    """Flies: takes pictures until stopped or until a recording ends. Mutable, one thread."""

    def __init__(
        self,
        newest: Newest,
        camera: Camera,
        locator: Locator,
        publisher: Publisher,
        options: FlyOptions,
        clocks: Clocks,
        *,
        link: AutopilotLink | None = None,
        sink: LogSink | None = None,
        second_look: SecondLook | None = None,
        start: Callable[[], Prior | None] = lambda: None,
        notifier: Notifier | None = None,
    ) -> None:
        """`start` says where the flight begins, when the first view is placed."""
        self._newest, self._camera, self._locator = newest, camera, locator
        self._publisher, self.options, self._clocks = publisher, options, clocks
        self._link, self._sink, self._second = link, sink, second_look
        self._start: Callable[[], Prior | None] | None = start
        self._notifier = notifier or Notifier("")
        self.tally, self._teller, self._frozen = Tally(), Teller(), FrozenCheck()
        self.health: Health | None = None
        self._begun_ns = self._confident_ns = clocks.mono_ns()
        self._tick_ns = 0
        self._picture_ns: int | None = None
        self._last: states.Saved | None = None
        self._saved: states.Saved | None = None
        self._off = 0.0, 0.0
        self._utc_ahead_ns = clocks.utc_ns() - clocks.mono_ns()
        self._seen = {"jumps": 0, "outages": 0, "failed": 0, "lost": 0}
        self._map_id = _file_id(options.map_path)
        self._boot_id = states.boot_id()

    def run(self, stopping: threading.Event) -> None:
        """Fly until `stopping` is set, or until a recording ends."""
        self._log(lambda sink: sink.options(dict(self.options.told)))
        self._notifier.tell("READY=1", "STATUS=waiting for pictures")
        try:
            while not stopping.is_set() and not self._newest.is_over:
                try:
                    self.step(0.1)
                except Exception:  # whatever it was, the next view may be better
                    log.exception("runner")
                    self._count("internal_error")
        finally:
            self._notifier.tell("STOPPING=1")
            self._save_state()
            self._publisher.close()
            self._log(lambda sink: sink.close())

    def step(self, timeout_s: float) -> ViewResult | None:
        """Take the newest picture, waiting so long for it; what came out, None without any."""
        picture = self._newest.take(timeout_s)
        result = None if picture is None else self._turn(picture)
        now_ns = self._clocks.mono_ns()
        if now_ns >= self._tick_ns:
            self._tick_ns = now_ns + TICK_NS
            self._tick(now_ns)
        return result

    def _turn(self, picture: Picture) -> ViewResult | None:
        """One picture whose turn has come."""
        self._picture_ns = self._clocks.mono_ns()
        self._count("taken")
        if self._picture_ns - picture.exposed_ns > self.options.deadline_s * 1e9:
            self._count("late")
            return None
        told, camera = Told(None), self._camera
        refused = self._bad_picture(picture)
        if refused is None and picture.grey is not None:
            try:
                height, width = picture.grey.shape
                camera = fitted(camera, width, height, picture.frame)
            except CameraError as error:
                refused = self._refusal("wrong_camera", "wrong_camera", str(error))
        telemetry = None
        if refused is None:
            told, telemetry = self._telemetry(picture)
            refused = self._missing(telemetry)
        if refused is not None or telemetry is None or picture.grey is None:
            outcome = refused or NoFix("bad_image", "there is no picture")
            result = self._result(picture, outcome, math.nan)
            self._log(lambda sink: sink.result(result))
            self._publisher.publish(result, picture.exposed_ns, told, judged=False)
            return result
        return self._placed(picture, View(picture.grey, camera, telemetry), told)

    def _placed(self, picture: Picture, view: View, told: Told) -> ViewResult:
        """A view that can be placed: logged, located, published."""
        if self._start is not None:
            prior, self._start = self._start(), None
            telemetry = replace(view.telemetry, prior=prior or view.telemetry.prior)
            view = replace(view, telemetry=telemetry)
        telemetry = view.telemetry
        self._log(lambda sink: sink.view(picture.number, picture.frame, view.grey, telemetry))
        outcome: Fix | NoFix
        try:
            outcome, latency_ms = locate_view(self._locator, view)
        except CameraError as error:  # on a recorded flight an error, here it must not end
            outcome = self._refusal("wrong_camera", "wrong_camera", str(error))
            latency_ms = math.nan
        self._count("processed")
        if isinstance(outcome, NoFix) and outcome.reason == "internal_error":
            self._count("internal_error")
        result = self._result(picture, outcome, latency_ms)
        accepted = self.options.accept(outcome) if self.options.accept else outcome
        self._publisher.publish(
            replace(result, outcome=accepted), picture.exposed_ns, told, judged=True
        )
        now_ns = self._clocks.mono_ns()
        self.tally.add_latency(now_ns, (now_ns - picture.exposed_ns) / 1e9)
        self._log(lambda sink: sink.result(result))
        self._note(result, telemetry, picture.exposed_ns)
        if self._second is not None:
            corrected = self.options.mount.corrected(telemetry) if self.options.mount else telemetry
            found = result.state not in ("searching", "lost") and isinstance(outcome, Fix)
            self._second.look(replace(view, telemetry=corrected), found, now_ns)
        return result

    def _note(self, result: ViewResult, telemetry: Telemetry, exposed_ns: int) -> None:
        """Remember a sure position, and how far it lies from what was told."""
        fix = result.outcome
        if not isinstance(fix, Fix) or not fix.confidence >= self.options.min_confidence:
            return
        if result.state not in (None, "tracking"):
            return
        self._confident_ns = self._clocks.mono_ns()
        self._count("sure")
        mount = self.options.mount
        self._off = offsets(fix, mount.corrected(telemetry) if mount else telemetry)
        if not self.options.heading_known:
            self._off = 0.0, self._off[1]
        utc_ns = exposed_ns + self._clocks.utc_ns() - self._clocks.mono_ns()
        std_m = error_ellipse(fix.cov_en_m2)[0]
        self._last = states.Saved(
            fix.lat_deg, fix.lon_deg, std_m, utc_ns, exposed_ns, self._boot_id
        )

    def _result(self, picture: Picture, outcome: Fix | NoFix, latency_ms: float) -> ViewResult:
        state = self._locator.state_name
        return ViewResult(picture.frame, picture.time_ns, outcome, latency_ms, state)

    def _bad_picture(self, picture: Picture) -> NoFix | None:
        """Why a picture cannot be used; the reasons of the localizer where it shows nothing."""
        if picture.grey is None:
            self._count("bad_picture")
            return picture.problem or NoFix("bad_image", "picture could not be decoded")
        shown = check_picture(picture.grey)
        repeat = self._frozen.is_repeat(picture.grey)
        if shown is not None:
            self._count("bad_picture")
            return shown
        if repeat:
            detail = f"the same picture for the {self._frozen.repeats + 1}th time"
            return self._refusal("frozen", "frozen_picture", detail)
        return None

    def _telemetry(self, picture: Picture) -> tuple[Told, Telemetry]:
        """What is told of the exposure; waits a little for what comes after it."""
        if self.options.recorded or self._link is None:
            nothing = Telemetry(picture.time_ns, math.nan, math.nan, math.nan, math.nan)
            return picture.reported or Told(None), picture.telemetry or nothing
        until_ns = self._clocks.mono_ns() + round(self.options.telemetry_wait_s * 1e9)
        while not self._link.covers(picture.exposed_ns) and self._clocks.mono_ns() < until_ns:
            self._clocks.sleep(_WAIT_S)
        told = self._link.told_at(picture.exposed_ns)
        return told, told.telemetry(picture.time_ns, self.options.mount_deg)

    def _missing(self, telemetry: Telemetry) -> NoFix | None:
        missing = [
            name for name in telemetry.missing() if name != "yaw_deg" or self.options.heading_known
        ]
        if not missing:
            return None
        detail = f"not told at the exposure: {', '.join(missing)}"
        return self._refusal("no_telemetry", "no_telemetry", detail)

    def _refusal(self, count: str, reason: str, detail: str) -> NoFix:
        self._count(count)
        return NoFix(reason, detail)

    def _count(self, name: str) -> None:
        self.tally.add(self._clocks.mono_ns(), name)

    def _log(self, call: Callable[[LogSink], None]) -> None:
        """Write to the log; a log that fails is a matter of health."""
        if self._sink is None:
            return
        try:
            call(self._sink)
        except Exception as error:
            if self.tally.total["log_failed"] == 0:
                log.warning("flight log: %s", error)
            self._count("log_failed")

    def _tick(self, now_ns: int) -> None:
        """Once a second: health, who wants to know it, and what is kept over a restart."""
        self._count_changes()
        self._save_state()
        health = self.health = judge(self._snapshot(now_ns))
        plain = self._plain(health)
        self._publisher.health(plain)
        self._log(lambda sink: sink.health(plain))
        self._notifier.tell("WATCHDOG=1", f"STATUS={health.text()}")
        if self._link is None:
            return
        self._link.system_status = health.level.value
        heard = self._link.target is not None  # else nobody would hear it
        if heard and self._teller.due(health, now_ns):
            text = health.text().encode("ascii", "replace")
            self._link.send(dialect().MAVLink_statustext_message(health.level.severity, text))
        if self._publisher.messenger is not None:
            self._publisher.messenger.send_origin(self._link.origin, self._link.target)

    def _count_changes(self) -> None:
        """What others counted since the last time."""
        now = {
            "jumps": 0 if self._link is None else self._link.sync.jumps,
            "outages": self._newest.outages,
            "failed": self._publisher.failed,
            "lost": 0 if self._sink is None else sum(self._sink.lost.values()),
        }
        names = {
            "jumps": "clock_jump",
            "outages": "camera_lost",
            "failed": "output_failed",
            "lost": "log_failed",
        }
        for key, name in names.items():
            if now[key] > self._seen[key]:
                self._count(name)
        self._seen = now
        ahead_ns = self._clocks.utc_ns() - self._clocks.mono_ns()
        if abs(ahead_ns - self._utc_ahead_ns) > UTC_JUMP_NS:
            self._count("clock_jump")
        self._utc_ahead_ns = ahead_ns

    def _snapshot(self, now_ns: int) -> Snapshot:
        counts = self.tally.counts(now_ns)
        link = None
        if self._link is not None:
            link = self._link.status()
        uses_link = link is not None and not self.options.recorded
        picture_ns = self._begun_ns if self._picture_ns is None else self._picture_ns
        looked = (0.0, 0.0) if self._second is None else self._second.offsets(now_ns)
        off = looked if any(looked) else self._off
        state = self._locator.state_name
        if state is None and self._picture_ns is None:
            state = "searching"
        return Snapshot(
            running_s=(now_ns - self._begun_ns) / 1e9,
            counts=counts,
            picture_age_s=(now_ns - picture_ns) / 1e9,
            telemetry_age_s=link.attitude_age_s if link and uses_link else 0.0,
            link_age_s=link.heard_age_s if link else 0.0,
            low_confidence_s=(now_ns - self._confident_ns) / 1e9,
            latency_s=self.tally.latency_s(0.95),
            state=state,
            synced=link.synced if link else True,
            map_there=_file_id(self.options.map_path) == self._map_id,
            heading_off_deg=off[0],
            log_scale_off=off[1],
        )

    def _plain(self, health: Health) -> dict[str, Any]:
        total = self.tally.total
        return {
            "health": health.level.name,
            "reasons": list(health.reasons),
            "utc_s": round(self._clocks.utc_ns() / 1e9, 3),
            "state": self._locator.state_name,
            "counts": {**dict(sorted(total.items())), "replaced": self._newest.replaced},
            "withheld": dict(sorted(self._publisher.gate.withheld.items())),
            "sent": dict(sorted(self._publisher.gate.sent.items())),
            "age_p50_ms": round(self.tally.latency_s(0.5) * 1e3, 1),
            "age_p95_ms": round(self.tally.latency_s(0.95) * 1e3, 1),
        }

    def _save_state(self) -> None:
        path, last = self.options.state_path, self._last
        if path is None or last is None or last == self._saved:
            return
        stamp = self._link.signing_now() if self._link is not None else None
        try:
            states.save(path, replace(last, signing_timestamp_10us=stamp or 0))
            self._saved = last
        except OSError as error:
            if self.tally.total["state_failed"] == 0:
                log.warning("state cannot be saved: %s", error)
            self._count("state_failed")


def _file_id(path: Path | None) -> tuple[int, int] | None:
    """Which file is there by that name; None where there is none."""
    try:
        found = path.stat() if path is not None else None
    except OSError:
        return None
    return None if found is None else (found.st_dev, found.st_ino)
