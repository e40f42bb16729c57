"""The loop of `orthonav fly`: newest image, telemetry at its exposure, position, messages.

It runs on one thread, fed by a camera thread and a link thread.
"""

import logging
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from orthonav.core.errors import CameraError, MapChangedError, MapFileError
from orthonav.core.flight.heights import (
    DATUM_ADVICE,
    FlownHeights,
    assumed_heights,
    needs_datum,
)
from orthonav.core.flight.mount import Mount
from orthonav.core.flight.recording import LONG_GAP_NS, fitted
from orthonav.core.geo.attitude import LOOKS_DOWN, Angles
from orthonav.core.geo.camera import Camera
from orthonav.core.localize.confidence import ALERT_LIMIT, Acceptance
from orthonav.core.localize.view import check_picture
from orthonav.core.records import CONFIDENT, Fix, NoFix, Prior, Telemetry, View, ViewResult
from orthonav.onboard import state as states
from orthonav.onboard.cameras import CameraImage, FrozenCheck, NewestImage
from orthonav.onboard.gnss.watch import GnssWatch
from orthonav.onboard.health import Health, HealthReporter, Monitor, judge, notify
from orthonav.onboard.latency import LatencyMonitor
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.gate import unavailable_text
from orthonav.onboard.messages.mavlink import dialect, status_texts
from orthonav.onboard.monitors import (
    EventCounter,
    TrackMonitor,
    camera_reasons,
    link_reasons,
    output_reasons,
    program_reasons,
)
from orthonav.onboard.motion import PAIR_INTERVAL
from orthonav.onboard.outputs import Publisher
from orthonav.onboard.run import MAP_CHANGED, MAP_DAMAGED, Locator, UnusableView, locate_view
from orthonav.onboard.telemetry import VehicleState

if TYPE_CHECKING:
    from orthonav.onboard.log import FlightLog

log = logging.getLogger(__name__)
MAX_AGE_S = 0.5
"""Images that are older when their processing starts are dropped; live ones count from arrival."""
TELEMETRY_WAIT_S = 0.15
"""Longest wait for telemetry after the exposure: three attitudes at 20 Hz, the least rate."""
UNKNOWN_VEHICLE = VehicleState(None)
Velocity = tuple[float, float]


@dataclass(frozen=True)
class LoopParameters:
    """Of the clocks, the log of withheld views, and the error of the latency."""

    utc_jump_s: float = 0.2
    """UTC that moves by more than this against the monotonic clock within a second was set."""
    withheld_s: float = PAIR_INTERVAL.min_s
    """Withheld views are logged at most so often: `orthonav calibrate --latency` compares them."""
    unusable_s: float = 1.0
    """Over unusable pictures the track is predicted at most so often: its noise is per view."""
    assumed_mps: float = 20.0
    """Speed, usual for small aircraft, that turns an error of the latency into a distance where
    none is known."""


LOOP = LoopParameters()


@dataclass(frozen=True)
class FlyOptions:
    """Options of the flight loop."""

    mount_deg: Angles = LOOKS_DOWN  # yaw, pitch, roll of the camera in the body
    mount: Mount | None = None  # calibrated, for the health only: the locator applies it
    heights: FlownHeights | None = None  # None where the map has no terrain
    heading_known: bool = True
    min_agl_m: float = 0.0  # lower views are not located
    recorded: bool = False  # telemetry comes with the image, from a recording or ROS
    accept: Acceptance = field(default_factory=lambda: Acceptance("confidence", CONFIDENT))
    map_change: Callable[[], str | None] = lambda: None
    """How the open map file was changed in place."""
    start: Callable[[], Prior | None] = lambda: None  # the prior of the first view
    state_path: Path | None = None
    # For a replay of the log.
    logged_options: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def min_confidence(self) -> float:
        """Of fixes that monitors use; also of accepted ones, unless an alert limit decides."""
        return self.accept.threshold if self.accept.criterion == "confidence" else CONFIDENT

    def accepts(self, fix: Fix) -> bool:
        by_limit = self.accept.criterion == ALERT_LIMIT
        return self.accept.accepts(fix) and (by_limit or fix.confidence >= self.min_confidence)


class _Taken(NamedTuple):
    """An image and what was reported at its exposure. `camera`: at its size; None where its picture
    must not be located. `problem`: of the picture; no position is sent for it."""

    image: CameraImage
    camera: Camera | None
    problem: NoFix | None
    vehicle: VehicleState
    telemetry: Telemetry

    @property
    def view(self) -> View | UnusableView:
        """What the locator gets: it bridges a picture that is too dark itself."""
        if self.camera is None or self.image.grey is None:
            assert self.problem is not None
            return UnusableView(self.telemetry, self.problem)
        return View(self.image.grey, self.camera, self.telemetry)


class Runner:
    """Processes images until it is stopped or a recording ends. Mutable; for one thread."""

    def __init__(
        self,
        newest: NewestImage,
        camera: Camera,
        locator: Callable[[], Locator],
        publisher: Publisher,
        options: FlyOptions,
        *,
        link: AutopilotLink | None = None,
        sink: "FlightLog | None" = None,
        gnss: GnssWatch | None = None,
        latency: LatencyMonitor | None = None,
    ) -> None:
        """`locator` makes one, again where the time of a recording goes back. `latency`: of a live
        camera; None where images carry the time of their exposure."""
        self._newest, self._camera = newest, camera
        self._new_locator, self._locator, self._start = locator, locator(), True
        self._publisher, self.options, self._clocks = publisher, options, publisher.clocks
        self._link, self._sink, self._gnss, self._latency = link, sink, gnss, latency
        counter = self.counter = EventCounter(self._clocks.mono_ns())
        self._reporter = HealthReporter()
        self._track_monitor = TrackMonitor(
            counter,
            publisher,
            lambda: self._locator.state_name,
            heading_known=options.heading_known,
        )
        self._monitors: list[Monitor] = [
            *([] if latency is None else [latency.reasons]),
            partial(camera_reasons, counter),
            partial(link_reasons, counter, link, options.recorded),
            partial(program_reasons, counter, options.map_change),
            partial(output_reasons, counter, publisher, link),
            *([] if gnss is None else [gnss.reasons]),
            self._track_monitor.reasons,
        ]
        self.health: Health | None = None
        self._frozen, self._heights_said, self._texts = FrozenCheck(), False, 0
        self._time_ns = self._tick_ns = self._withheld_ns = self._saved_ns = 0
        self._tracked_ns: int | None = None
        self._last: states.SavedState | None = None
        self._saved: states.SavedState | None = None
        self._utc_ahead_ns = self._clocks.utc_ns() - self._clocks.mono_ns()
        self._boot_id = states.boot_id()

    def run(self, stopping: threading.Event) -> None:
        self._log(lambda sink: sink.options(dict(self.options.logged_options)))
        notify("READY=1", "STATUS=waiting for images")
        try:
            is_over = False
            while not stopping.is_set() and not is_over:
                is_over = self._newest.is_over  # then only the last health is left
                try:
                    self.step(0.1)
                except Exception:  # the flight continues with the next view
                    log.exception("unexpected error in the flight loop")
                    self._count("internal_error")
        finally:
            notify("STOPPING=1")
            self._save_state()
            self._publisher.close()
            self._log(lambda sink: sink.close())

    def step(self, timeout_s: float) -> ViewResult | None:
        image = self._newest.take(timeout_s)
        result = None if image is None else self._process(image)
        now_ns = self._clocks.mono_ns()
        if now_ns >= self._tick_ns or (image is None and self._newest.is_over):
            self._tick_ns = now_ns + 10**9
            self._tick(now_ns)
        return result

    def _process(self, image: CameraImage) -> ViewResult | None:
        now_ns, arrived_ns, latency = self._clocks.mono_ns(), image.exposed_ns, self._latency
        self._count("taken")
        if latency is not None and image.interruptions is not None:
            latency.arrived(arrived_ns, image.interruptions)
        if now_ns - arrived_ns > MAX_AGE_S * 1e9:
            self._count("late")
            return None
        if latency is not None:
            delay_ns = round(latency.delay_s * 1e9)
            exposed_ns, time_ns = image.exposed_ns - delay_ns, image.time_ns - delay_ns
            image = replace(image, exposed_ns=exposed_ns, time_ns=time_ns)
        self._restart_after_jump(image.time_ns)
        # Parts of a changed map in memory would still give positions; stopping shows it at once.
        change = self.options.map_change()
        if change is not None:
            return self._refuse(image, NoFix(MAP_CHANGED, f"map file was changed: {change}"))
        camera, problem = self._picture(image)
        if latency is not None and problem is not None and problem.reason == "frozen_image":
            latency.frozen(arrived_ns)
        if problem is not None and not self._may_predict(image):
            return self._refuse(image, problem)  # before it waits for telemetry
        taken = _Taken(image, camera, problem, *self._telemetry(image))
        return (
            self._located(taken) if latency is None else self._watched(taken, arrived_ns, latency)
        )

    def _watched(self, taken: _Taken, arrived_ns: int, latency: LatencyMonitor) -> ViewResult:
        """The result of a view that is located only where nothing contradicts the latency."""
        try:
            if latency.may_locate:
                return self._located(taken)
            if taken.problem is not None:
                return self._refuse(taken.image, taken.problem, taken.vehicle)
            return self._withhold(taken, latency)
        finally:
            grey, camera, link = taken.image.grey, taken.camera, self._link
            if taken.problem is None and link is not None and camera is not None:
                assert grey is not None
                latency.observe(arrived_ns, grey, camera, link.state_at, link.covered_ns)

    def _restart_after_jump(self, time_ns: int) -> None:
        """Begin again where a recorded image is earlier than the one before by over a second: it
        belongs to another run."""
        before_ns, self._time_ns = self._time_ns, time_ns
        if not self.options.recorded or time_ns > before_ns - 10**9:
            return
        log.warning("time went back by %.1f s: the track begins again", (before_ns - time_ns) / 1e9)
        self._locator, self._start = self._new_locator(), True
        self._tracked_ns = None
        if self.options.heights is not None:
            self.options.heights.observe(time_ns, NoFix("searching", ""), "searching")

    def _refuse(
        self, image: CameraImage, reason: NoFix, vehicle: VehicleState = UNKNOWN_VEHICLE
    ) -> ViewResult:
        """The result of an image of which the locator learns nothing."""
        result = self._result(image, reason, math.nan)
        self._log(lambda sink: sink.result(result))
        self._publisher.publish(
            result, image.exposed_ns, vehicle, judged=False, withheld=reason.reason
        )
        return result

    def _withhold(self, taken: _Taken, latency: LatencyMonitor) -> ViewResult:
        """The result of a view whose time of exposure is in doubt: the track must not get it. Some
        are logged, for `orthonav calibrate --latency`."""
        image, reason = taken.image, latency.reasons()[0]
        self._count(reason)
        result = self._result(image, NoFix(reason, latency.detail()), math.nan)
        if image.exposed_ns - self._withheld_ns >= LOOP.withheld_s * 1e9:
            self._withheld_ns = image.exposed_ns
            self._log_view(taken, withheld=True)
            self._log(lambda sink: sink.result(result))
        self._publisher.publish(
            result, image.exposed_ns, taken.vehicle, judged=False, withheld=reason
        )
        return result

    def _log_view(self, taken: _Taken, *, withheld: bool) -> None:
        image, telemetry = taken.image, taken.telemetry
        grey = None if taken.camera is None else image.grey
        used_ms = None if self._latency is None else self._latency.delay_s * 1e3
        self._log(
            lambda sink: sink.view(image.number, image.frame, grey, telemetry, used_ms, withheld)
        )

    def _located(self, taken: _Taken) -> ViewResult:
        image, heights = taken.image, self.options.heights
        known = self._above_ground(taken.telemetry)
        if self._start and isinstance(known, Telemetry):
            known = self._corrected(self._from_start(taken.telemetry))
        if isinstance(known, NoFix):
            return self._refuse(image, known, taken.vehicle)
        self._track_monitor.moved(known)
        self._say_heights(taken.telemetry)
        telemetry = self._over_gap(known, image.exposed_ns)
        taken = taken._replace(telemetry=telemetry)
        self._log_view(taken, withheld=False)
        is_search = self._locator.state_name in ("searching", "lost")
        outcome, latency_ms = self._placed(taken, known)
        self._tracked_ns = image.exposed_ns
        self._count("processed")
        vehicle = self._with_altitude(taken.vehicle, outcome, known)
        if self._latency is not None and isinstance(outcome, Fix):
            outcome = _with_latency(outcome, known, self._latency.std_s)
        result = self._result(image, outcome, latency_ms)
        doubt = self._latency_doubt(result, image.exposed_ns)
        if doubt is not None:
            self._count(doubt)
        elif heights is not None:
            heights.observe(telemetry.time_ns, outcome, result.state)
        if taken.problem is not None:
            doubt = taken.problem.reason
        self._publisher.publish(result, image.exposed_ns, vehicle, judged=True, withheld=doubt)
        self._log(lambda sink: sink.result(result))
        if doubt is None:
            now_ns = self._clocks.mono_ns()
            if not is_search:  # on the whole map, which takes its time
                self.counter.add_latency(now_ns, (now_ns - image.exposed_ns) / 1e9)
            self._note(result, telemetry, image.exposed_ns)
        return result

    def _may_predict(self, image: CameraImage) -> bool:
        """Whether the track is predicted to an unusable picture. One that has not begun is not."""
        if self._start:
            return False
        is_replay = self.options.recorded and image.vehicle is None
        if is_replay or self._tracked_ns is None:
            return True
        return image.exposed_ns - self._tracked_ns >= LOOP.unusable_s * 1e9

    def _from_start(self, telemetry: Telemetry) -> Telemetry:
        """With the start position, which is given once: the track must get it."""
        prior, self._start = self.options.start(), False
        self._track_monitor.started(prior, telemetry.time_ns)
        return replace(telemetry, prior=prior or telemetry.prior)

    def _with_altitude(
        self, vehicle: VehicleState, outcome: Fix | NoFix, telemetry: Telemetry
    ) -> VehicleState:
        heights, below = self.options.heights, telemetry.below
        if math.isfinite(vehicle.amsl_m):
            return vehicle
        if below is not None and (heights is None or heights.datum_known):
            return replace(vehicle, amsl_m=below.height_m + telemetry.agl_m)
        if heights is None or not isinstance(outcome, Fix):
            return vehicle
        try:
            return replace(vehicle, amsl_m=heights.ground_m(outcome) + telemetry.agl_m)
        except MapFileError:  # reported when the next view needs it
            return vehicle

    def _over_gap(self, telemetry: Telemetry, exposed_ns: int) -> Telemetry:
        """Telemetry whose velocity is the mean since the view before, where that is long ago."""
        before_ns, link = self._tracked_ns, self._link
        if self.options.recorded or before_ns is None or link is None:
            return telemetry
        if telemetry.vel_en_mps is None or exposed_ns - before_ns <= LONG_GAP_NS:
            return telemetry
        return replace(telemetry, vel_en_mps=link.mean_velocity(before_ns, exposed_ns))

    def _placed(self, taken: _Taken, reported: Telemetry) -> tuple[Fix | NoFix, float]:
        failed = partial(self._count, "internal_error")
        try:
            outcome, latency_ms = locate_view(self._locator, taken.view, failed)
        except CameraError as error:  # ends `orthonav localize`, but must not end a flight
            return self._counted("wrong_camera", NoFix("wrong_camera", str(error))), math.nan
        if isinstance(outcome, Fix):
            mean = taken.telemetry.vel_en_mps
            outcome = _at_exposure(outcome, mean, reported.vel_en_mps)
        return outcome, latency_ms

    def _latency_doubt(self, result: ViewResult, exposed_ns: int) -> str | None:
        """Why a position is withheld although it was found: the latency is in doubt."""
        fix, latency, link = result.outcome, self._latency, self._link
        if latency is None:
            return None
        if isinstance(fix, Fix) and result.is_recognized and link is not None:
            place = fix.lat_deg, fix.lon_deg
            latency.located(exposed_ns, place, fix.std_m, link.mean_velocity)
        return next(iter(latency.reasons()), None)

    def _note(self, result: ViewResult, telemetry: Telemetry, exposed_ns: int) -> None:
        now_ns, fix, mount = self._clocks.mono_ns(), result.outcome, self.options.mount
        if result.is_recognized:
            self._count("confident")
        is_tracking = result.state in (None, "tracking")
        if not isinstance(fix, Fix) or not is_tracking:
            return
        if not fix.confidence >= self.options.min_confidence:
            return
        self._track_monitor.found(fix, mount.corrected(telemetry) if mount else telemetry, now_ns)
        utc_ns = exposed_ns + self._clocks.utc_ns() - self._clocks.mono_ns()
        self._last = states.SavedState(
            fix.lat_deg, fix.lon_deg, fix.std_m, utc_ns, exposed_ns, self._boot_id
        )

    def _result(self, image: CameraImage, outcome: Fix | NoFix, latency_ms: float) -> ViewResult:
        state, risk = self._locator.state_name, self.options.accept.risk
        result = ViewResult(image.frame, image.time_ns, outcome, latency_ms, state, risk=risk)
        if self._gnss is not None:
            result = self._gnss.view(result, image.exposed_ns)
        fix = result.outcome
        return replace(result, accepted=self.options.accepts(fix) if isinstance(fix, Fix) else None)

    def _picture(self, image: CameraImage) -> tuple[Camera | None, NoFix | None]:
        """Camera and problem as in `_Taken`."""
        grey = image.grey
        if grey is None:
            why = image.problem or NoFix("bad_image", "image could not be decoded")
            return None, self._counted("bad_image", why)
        repeat = self._frozen.is_repeat(grey)
        try:
            camera = fitted(self._camera, grey.shape[1], grey.shape[0], image.frame)
        except CameraError as error:
            return None, self._counted("wrong_camera", NoFix("wrong_camera", str(error)))
        shown = check_picture(grey, camera.mask)
        if shown is not None:
            return camera, self._counted("bad_image", shown)
        if repeat:
            detail = f"{self._frozen.repeats + 1} identical images in a row"
            return None, self._counted("frozen", NoFix("frozen_image", detail))
        return camera, None

    def _telemetry(self, image: CameraImage) -> tuple[VehicleState, Telemetry]:
        if self.options.recorded or self._link is None:
            nothing = Telemetry(image.time_ns, math.nan, math.nan, math.nan, math.nan)
            return image.vehicle or UNKNOWN_VEHICLE, image.telemetry or nothing
        until_ns = self._clocks.mono_ns() + round(TELEMETRY_WAIT_S * 1e9)
        while (self._link.covered_ns or 0) < image.exposed_ns and self._clocks.mono_ns() < until_ns:
            self._clocks.sleep(0.001)
        vehicle = self._link.state_at(image.exposed_ns)
        return vehicle, vehicle.telemetry(image.time_ns, self.options.mount_deg)

    def _corrected(self, telemetry: Telemetry) -> Telemetry | NoFix:
        """With the height above ground; `NoFix` where the terrain cannot be read."""
        heights = self.options.heights
        try:
            return telemetry if heights is None else heights.corrected(telemetry)
        except MapChangedError as error:
            return self._counted("internal_error", NoFix(MAP_CHANGED, str(error)))
        except MapFileError as error:  # a crafted part of the map
            return self._counted("internal_error", NoFix(MAP_DAMAGED, str(error)))

    def _above_ground(self, telemetry: Telemetry) -> Telemetry | NoFix:
        """With the height above ground, where a view can be located by it."""
        heights, least_m = self.options.heights, self.options.min_agl_m
        known = self._corrected(telemetry)
        if isinstance(known, NoFix):
            return known
        missing = [
            name for name in known.missing() if name != "yaw_deg" or self.options.heading_known
        ]
        if missing:
            detail = f"not reported at the exposure: {', '.join(missing)}"
            if heights is not None and not heights.datum_known and needs_datum(telemetry):
                detail = f"vertical datum of the map's terrain is unknown: {DATUM_ADVICE}"
            return self._counted("no_telemetry", NoFix("no_telemetry", detail))
        if known.agl_m < least_m:  # on the ground, and in the take-off
            detail = f"{known.agl_m:.0f} m above ground; views are located from {least_m:.0f} m"
            return self._counted("too_low", NoFix("too_low", detail))
        return known

    def _say_heights(self, telemetry: Telemetry) -> None:
        if self._heights_said:
            return
        self._heights_said = True
        name = None if self.options.heights is None else "the terrain of the map"
        said = assumed_heights(telemetry, name, "build the map with --dem")
        if said is not None:
            log.log(logging.WARNING if name is None else logging.INFO, "%s", said)

    def _counted(self, name: str, reason: NoFix) -> NoFix:
        self._count(name)
        return reason

    def _count(self, name: str) -> None:
        self.counter.add(self._clocks.mono_ns(), name)

    def _log(self, call: "Callable[[FlightLog], None]") -> None:
        if self._sink is None:
            return
        try:
            call(self._sink)
        except Exception as error:
            if self.counter.total["log_failed"] == 0:
                log.warning("flight log: %s", error)
            self._count("log_failed")

    def _tick(self, now_ns: int) -> None:
        """Once a second: health and state."""
        self._follow(now_ns)
        self._save_state()
        texts = [] if self._gnss is None else self._gnss.tick(now_ns)
        detail = unavailable_text(self._publisher.gate.availability(now_ns))
        health = self.health = judge(self._monitors, now_ns, detail)
        plain = self._plain(health, now_ns)
        self._publisher.health(plain)
        self._log(lambda sink: sink.health(plain))
        notify("WATCHDOG=1", f"STATUS={health.text()}")
        if self._link is None:
            return
        self._link.system_status = health.level.value
        if self._link.target is not None:
            if self._reporter.due(health, now_ns):
                texts = [(health.level.severity, health.text()), *texts]
            for severity, text in texts:
                self._send_text(self._link, severity, text)
            if self._gnss is not None:
                _send_gnss(self._link, self._gnss, now_ns)
        if self._publisher.messenger is not None:
            self._publisher.messenger.find_origin()

    def _send_text(self, link: AutopilotLink, severity: int, text: str) -> None:
        self._texts += 1
        for each in status_texts(severity, text, self._texts):
            link.send(each)

    def _follow(self, now_ns: int) -> None:
        """Count what others counted since the tick before, and a clock of the computer that was
        set."""
        messenger = self._publisher.messenger
        totals = {
            "clock_jump": 0 if self._link is None else self._link.sync.jumps,
            "camera_lost": self._newest.outages,
            "output_failed": self._publisher.failed,
            "log_failed": 0 if self._sink is None else sum(self._sink.lost.values()),
            "slow_vision": 0 if messenger is None else messenger.too_slow,
            "incomplete": 0 if messenger is None else messenger.incomplete,
        }
        self.counter.follow(now_ns, totals)
        ahead_ns = self._clocks.utc_ns() - self._clocks.mono_ns()
        if abs(ahead_ns - self._utc_ahead_ns) > LOOP.utc_jump_s * 1e9:
            self._count("clock_jump")
        self._utc_ahead_ns = ahead_ns

    def _plain(self, health: Health, now_ns: int) -> dict[str, Any]:
        total, gate = self.counter.total, self._publisher.gate
        start_off_m = self._track_monitor.start_off_m(now_ns)
        return {
            "health": health.level.name,
            "reasons": list(health.reasons),
            "utc_s": round(self._clocks.utc_ns() / 1e9, 3),
            "state": self._locator.state_name,
            "counts": {**dict(sorted(total.items())), "replaced": self._newest.replaced},
            "withheld": dict(sorted(gate.withheld.items())),
            "sent": dict(sorted(gate.sent.items())),
            "age_p50_ms": round(self.counter.latency_s(0.5) * 1e3, 1),
            "age_p95_ms": round(self.counter.latency_s(0.95) * 1e3, 1),
            **({"start_off_m": round(start_off_m, 1)} if start_off_m else {}),
            **gate.availability(self._clocks.mono_ns()),
            **({} if self._gnss is None else {"gnss": self._gnss.plain()}),
            **({} if self._latency is None else self._latency.plain()),
        }

    def _save_state(self) -> None:
        path, last = self.options.state_path, self._last
        if path is None or last is None:
            return
        mono_ns = self._clocks.mono_ns()
        if last == self._saved and mono_ns - self._saved_ns < states.SAVE_S * 1e9:
            return
        stamp = self._link.signing_now() if self._link is not None else None
        try:
            maps = None if self._gnss is None else self._gnss.maps()
            states.save(path, replace(last, signing_timestamp_10us=stamp or 0), maps)
            self._saved, self._saved_ns = last, mono_ns
        except OSError as error:
            if self.counter.total["state_failed"] == 0:
                log.warning("state cannot be saved: %s", error)
            self._count("state_failed")


def _at_exposure(fix: Fix, mean: Velocity | None, reported: Velocity | None) -> Fix:
    """The fix with the velocity at the exposure instead of the mean, which has the same error."""
    own = fix.vel_en_mps
    if own is None or mean is None or reported is None or mean == reported:
        return fix
    east, north = (a + now - over for a, now, over in zip(own, reported, mean, strict=True))
    return replace(fix, vel_en_mps=(east, north))


def _with_latency(fix: Fix, telemetry: Telemetry, std_s: float) -> Fix:
    """Fix whose covariance and confidence include the distance flown in the standard deviation of
    the latency; where the velocity is not known, at `assumed_mps` in all directions."""
    velocity = np.array(telemetry.vel_en_mps or fix.vel_en_mps or (math.nan, math.nan))
    if not np.isfinite(velocity).all():
        off_m = std_s * LOOP.assumed_mps
        return fix.with_covariance(fix.cov_en_m2 + off_m**2 * np.eye(2))
    return fix.with_covariance(fix.cov_en_m2 + std_s**2 * np.outer(velocity, velocity))


def _send_gnss(link: AutopilotLink, gnss: GnssWatch, now_ns: int) -> None:
    boot_ms = ((link.boot_ns(now_ns) or 0) // 1_000_000) % 2**32
    for name, value in ((b"gnss_fault", float(gnss.code)), (b"gnss_diff", gnss.difference_m)):
        link.send(dialect().MAVLink_named_value_float_message(boot_ms, name, value))
