"""Flights of the fault suite: a path, a live camera and an autopilot with simulated clocks.

The flight loop is that of `orthonav fly` (`orthonav.onboard.fly.Runner`) with its tracker, latency
monitor, gate and link; only clocks, camera and port are replaced. Nothing waits: a flight takes as
long as its views take to locate. Messages are decoded by the reader of the tests.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from examples.simulated_autopilot import Encoder as Autopilot

from benchmarks.fakes import (
    BEGIN_NS,
    SAMPLE_S,
    Array,
    Grey,
    Port,
    S,
    Stream,
    Time,
    answers,
    wandering,
)
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.records import Fix
from orthonav.core.track.tracker import Tracker
from orthonav.onboard.cameras import LiveCamera, NewestImage
from orthonav.onboard.fly import FlyOptions, Runner
from orthonav.onboard.latency import LatencyMonitor
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.messages.gate import Gate
from orthonav.onboard.outputs import Messenger, Publisher
from orthonav.onboard.run import Locator
from orthonav.onboard.telemetry import TelemetryBuffer

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
STATED_S = 0.12
"""Stated and true latency of the undisturbed camera."""
VIEWS_HZ, STEP_S = 5.0, 0.04
"""Rates of the camera, and of telemetry: 25 Hz."""
BEGIN_S = 15.0
"""Time on the path at the start: a late camera shows what was before."""
AHEAD_NS = -90 * S
FAR_M, FAR_STD = 35.0, 3.0
"""A message is wrong if its error exceeds both, the second in stated standard deviations."""
RIGHT_COUNT = 5
"""A flight ends so many right messages after its fault."""
G_MPS2, TURN_DEG_S = 9.81, 14.0
YAW_OFF_DEG, HEIGHT_SCALE, PITCH_OFF_DEG = 2.0, 1.03, 0.5
"""Constant errors of telemetry, undisturbed."""


@dataclass(frozen=True)
class State:
    """What an autopilot reports: angles (deg), velocity over ground (m/s), height (m)."""

    yaw: float
    pitch: float
    roll: float
    north: float
    east: float
    height: float


class Path2D:
    """An aircraft that steers to random places within `reach_m` of `middle`, in turbulence.

    `excursion`: times (s) between which it flies to `outside` (east, north), metres.
    """

    def __init__(
        self,
        seconds: float,
        seed: int,
        *,
        reach_m: float,
        speed_mps: float,
        agl_m: float,
        turbulence_deg: float = 1.0,
        excursion: tuple[float, float] | None = None,
        outside: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        rng = np.random.default_rng([seed, 21])
        count = int(seconds / SAMPLE_S) + 1
        self._times = np.arange(count) * SAMPLE_S
        self.agl_m = agl_m
        place, course = rng.uniform(-0.3, 0.3, 2) * reach_m, rng.uniform(-np.pi, np.pi)
        goal = rng.uniform(-1, 1, 2) * reach_m
        places, courses = np.zeros((count, 2)), np.zeros(count)  # east, north; clockwise
        for i, time_s in enumerate(self._times):
            away = excursion is not None and excursion[0] <= time_s < excursion[1]
            if away:
                goal = np.array(outside)
            elif np.hypot(*(goal - place)) < 4 * speed_mps or np.abs(goal).max() > reach_m:
                goal = rng.uniform(-1, 1, 2) * reach_m
            wanted = math.atan2(*(goal - place)) - course
            most = math.radians(TURN_DEG_S) * SAMPLE_S
            course += min(max(math.remainder(wanted, math.tau), -most), most)
            place = place + speed_mps * SAMPLE_S * np.array([math.sin(course), math.cos(course)])
            places[i], courses[i] = place, course
        kernel = np.hanning(76) / np.hanning(76).sum()
        courses = np.convolve(np.pad(courses, 38, mode="edge"), kernel, mode="same")[38:-38]
        rate = np.gradient(courses, SAMPLE_S)
        shaken = [wandering(rng, count, turbulence_deg, each) for each in (0.25, 0.3, 0.5)]
        self._roll = np.degrees(np.arctan(speed_mps * rate / G_MPS2)) + shaken[0]
        self._pitch = 2.0 + shaken[1]
        self._yaw = np.degrees(courses) + 0.5 * shaken[2]
        self._places = places
        self._velocity: Array = np.asarray(np.gradient(places, SAMPLE_S, axis=0), np.float64)

    def attitude(self, time_s: float) -> tuple[float, float, float]:
        """True yaw, pitch, roll (deg)."""
        values = (self._yaw, self._pitch, self._roll)
        yaw, pitch, roll = (float(np.interp(time_s, self._times, each)) for each in values)
        return yaw, pitch, roll

    def place(self, time_s: float) -> Array:
        """True metres east and north (2,)."""
        return np.array([np.interp(time_s, self._times, each) for each in self._places.T])

    def reported(self, time_s: float) -> State:
        yaw, pitch, roll = self.attitude(time_s)
        east, north = (np.interp(time_s, self._times, each) for each in self._velocity.T)
        off = yaw + YAW_OFF_DEG, pitch + PITCH_OFF_DEG, roll
        return State(*off, float(north), float(east), HEIGHT_SCALE * self.agl_m)


@dataclass(frozen=True, eq=False)
class World:
    """A map, and pictures of the ground around its middle.

    `picture(place, attitude, agl_m, rng)`: what the camera sees from a place (2,) metres east and
    north of the origin of `frame`. `reach_m`: half the side of the square that is flown over.
    """

    localizer: Localizer
    frame: LocalFrame
    picture: Callable[[Array, tuple[float, float, float], float, np.random.Generator], Grey]
    reach_m: float
    agl_m: float
    speed_mps: float


@dataclass(frozen=True)
class Fault:
    """What is wrong from its begin on; times `t` are seconds since then.

    `delay_s(number)` by image number and `t`: exposure to arrival. `picture`: what arrives instead.
    `arrives`: whether an image arrives. `state`: what the autopilot reports, None for nothing.
    `others`: frames of other vehicles. `begins`: called once. `ground_en_m`: displacement
    of the ground under the aircraft against the map.
    """

    name: str
    group: str
    seconds: float = 10.0
    from_start: bool = False
    delay_s: Callable[[int, float], float] | None = None
    arrives: Callable[[int, float], bool] | None = None
    picture: Callable[["FaultFlight", Grey, float], Grey] | None = None
    state: Callable[["FaultFlight", State, float], State | None] | None = None
    others: Callable[["FaultFlight", State, int], list[bytes]] | None = None
    begins: Callable[["FaultFlight"], None] | None = None
    ground_en_m: tuple[float, float] = (0.0, 0.0)
    stated_s: float | None = STATED_S
    leaves_map: bool = False
    detectable: bool = True


@dataclass(frozen=True)
class Sent:
    """A message: when (s since the start), error (m), and in standard deviations of its fix."""

    at_s: float
    error_m: float
    sigmas: float

    @property
    def is_wrong(self) -> bool:
        """Whether it is off by more than anybody would expect."""
        return self.error_m > FAR_M and self.sigmas > FAR_STD


@dataclass(frozen=True)
class Report:
    """What a flight did. Times in seconds since its start.

    `views`: times of all images that arrived. `fault_s`: begin and end of the fault.
    """

    fault: Fault
    views: list[float] = field(repr=False)
    sent: list[Sent] = field(repr=False)
    fault_s: tuple[float, float] = (math.nan, math.nan)
    withheld: dict[str, int] = field(default_factory=dict)

    def during(self) -> list[Sent]:
        return [each for each in self.sent if self.fault_s[0] <= each.at_s < self.fault_s[1]]

    def wrong(self) -> list[Sent]:
        """Wrong messages of the whole flight."""
        return [each for each in self.sent if each.is_wrong]

    def worst_m(self) -> float:
        """Worst error of a message since the fault began; NaN without one."""
        errors = [each.error_m for each in self.sent if each.at_s >= self.fault_s[0]]
        return max(errors, default=math.nan)

    def recovery_s(self) -> float:
        """From the end of the fault to the next right message; infinite where none came."""
        right = (
            each.at_s - self.fault_s[1]
            for each in self.sent
            if each.at_s >= self.fault_s[1] and each.error_m <= FAR_M
        )
        return next(right, math.inf)

    def lead_in(self) -> tuple[int, int]:
        """Messages and views of the undisturbed time before the fault, from the first message."""
        begin = self.sent[0].at_s if self.sent else math.inf
        sent = sum(each.at_s < self.fault_s[0] for each in self.sent)
        return sent, sum(begin <= each < self.fault_s[0] for each in self.views)


def telemetry_frames(autopilot: Autopilot, state: State, boot_ns: int) -> list[bytes]:
    """Attitude, height above home and velocity, as an autopilot sends them."""
    made = [
        autopilot.attitude(boot_ns, state.yaw, state.pitch, state.roll),
        autopilot.home(boot_ns, state.height),
    ]
    if math.isfinite(state.north):
        made.append(autopilot.local(boot_ns, (state.north, state.east, 0.0)))
    return made


class FaultFlight:
    """One flight with one fault. Mutable."""

    def __init__(
        self,
        world: World,
        fault: Fault,
        *,
        seed: int,
        lead_s: float,
        recovery_s: float,
        map_change: Callable[[], str | None] = lambda: None,
        locator: Callable[["FaultFlight"], Locator] = lambda flight: Tracker(
            flight.world.localizer
        ),
    ) -> None:
        self.world: World = world
        self.fault = fault
        self.rng = np.random.default_rng([seed, 22])
        begin_s = 0.0 if fault.from_start else lead_s
        self.fault_s = begin_s, begin_s + fault.seconds
        self.end_s = begin_s + fault.seconds + recovery_s
        away = tuple(BEGIN_S + each for each in self.fault_s)
        self.path = Path2D(
            BEGIN_S + self.end_s + 1,
            seed,
            reach_m=world.reach_m,
            speed_mps=world.speed_mps,
            agl_m=world.agl_m,
            excursion=(away[0], away[0] + 0.55 * fault.seconds) if fault.leaves_map else None,
            outside=(1.9 * world.reach_m, 0.0),
        )
        self.time, self.boot_ahead_ns = Time(), AHEAD_NS
        clocks = self.time.clocks
        self.port, self.autopilot, self.other = Port(), Autopilot(), Autopilot(2)
        self.link = AutopilotLink(self.port.open, TelemetryBuffer(), clocks)  # type: ignore[arg-type]  # a fake of it
        self.gate = Gate()
        messenger = Messenger(self.gate, self.link, clocks)
        publisher = Publisher(self.gate, clocks, messenger=messenger)
        self._camera = LiveCamera(0, clocks, capture=lambda _: Stream(self._seen))
        self._newest = NewestImage()
        self.runner = Runner(
            self._newest,
            CAMERA,
            lambda: locator(self),
            publisher,
            FlyOptions(map_change=map_change),
            link=self.link,
            latency=LatencyMonitor(fault.stated_s),
        )
        self._inbox: dict[str, list[dict[str, Any]]] = {}
        self._number, self.exposed_s = 0, 0.0
        self._views: list[float] = []
        self._sent: list[Sent] = []
        self._hear(self.autopilot.heartbeat())

    @property
    def since_s(self) -> float:
        return (self.time.now_ns - BEGIN_NS) / S

    def fly(self) -> Report:
        """Fly to the end, or until the flight has recovered."""
        began = False
        due_s = 0.0
        while self.since_s < self.end_s and not self._has_recovered():
            self.time.go(STEP_S)
            if not began and self.since_s >= self.fault_s[0]:
                began = True
                if self.fault.begins is not None:
                    self.fault.begins(self)
            self._talk()
            if self.since_s >= due_s:
                due_s += 1 / VIEWS_HZ
                self._image()
        withheld = {str(key): value for key, value in self.gate.withheld.items()}
        return Report(self.fault, self._views, self._sent, self.fault_s, withheld)

    def _has_recovered(self) -> bool:
        after = [each for each in self._sent[-RIGHT_COUNT:] if each.at_s >= self.fault_s[1]]
        return len(after) == RIGHT_COUNT and all(each.error_m <= FAR_M for each in after)

    def _fault_t(self) -> float | None:
        """Time since the fault began; None outside it."""
        inside = self.fault_s[0] <= self.since_s < self.fault_s[1]
        return self.since_s - self.fault_s[0] if inside else None

    def _hear(self, *frames: bytes) -> None:
        self.port.coming.extend(frames)
        self.link.poll()

    def _received(self, name: str) -> list[dict[str, Any]]:
        """Messages of that name since it was last asked for."""
        for message in self.port.sent():
            self._inbox.setdefault(message["name"], []).append(message)
        return self._inbox.pop(name, [])

    def _talk(self) -> None:
        """Telemetry of this moment, and answers to TIMESYNC."""
        t, boot_ns = self._fault_t(), self.time.now_ns + self.boot_ahead_ns
        true = self.path.reported(BEGIN_S + self.since_s)
        state: State | None = true
        frames = []
        if t is not None and self.fault.state is not None:
            state = self.fault.state(self, true, t)
        asked = self._received("TIMESYNC")
        if state is not None:
            frames = telemetry_frames(self.autopilot, state, boot_ns)
            frames += answers(self.autopilot, asked, self.time.now_ns, self.boot_ahead_ns)
        if t is not None and self.fault.others is not None:
            frames += self.fault.others(self, true, boot_ns)
        self._hear(*frames)

    def _seen(self) -> Grey:
        t = self._fault_t()
        grey = self.seen_at(self.exposed_s)
        if t is not None and self.fault.picture is not None:
            grey = self.fault.picture(self, grey, t)
        return grey

    def seen_at(self, path_s: float, rng: np.random.Generator | None = None) -> Grey:
        """What the camera sees at a time of the path; `rng`: of the noise."""
        place = self.path.place(path_s)
        if self._fault_t() is not None:
            place = place + np.array(self.fault.ground_en_m)
        attitude = self.path.attitude(path_s)
        return self.world.picture(place, attitude, self.path.agl_m, rng or self.rng)

    def _image(self) -> None:
        t, delay_s = self._fault_t(), STATED_S
        self._number += 1
        if t is not None and self.fault.arrives and not self.fault.arrives(self._number, t):
            return
        if t is not None and self.fault.delay_s is not None:
            delay_s = self.fault.delay_s(self._number, t)
        self.exposed_s = BEGIN_S + self.since_s - delay_s
        self._views.append(self.since_s)
        image = self._camera.read()
        assert image is not None
        self._newest.put(image)
        result = self.runner.step(0)
        for message in self._received("GLOBAL_POSITION_SENSOR"):
            fix = None if result is None else result.outcome
            if isinstance(fix, Fix):
                self._sent.append(self._judged(message, fix))

    def _judged(self, message: dict[str, Any], fix: Fix) -> Sent:
        """A message against the truth of the exposure that it states."""
        path_s = BEGIN_S + self.since_s - message["processing_time"] / 1e6
        found = self.world.frame.en_from_latlon(message["lat"] * 1e-7, message["lon"] * 1e-7)
        off = np.asarray(found) - self.path.place(path_s)
        sigmas = math.sqrt(float(off @ np.linalg.solve(fix.cov_en_m2, off)))
        return Sent(self.since_s, float(np.hypot(*off)), sigmas)


def undisturbed(seconds: float) -> Fault:
    return Fault("undisturbed", "none", seconds=seconds)


def combined(camera: Fault, telemetry: Fault) -> Fault:
    """Both faults at once."""

    def state(flight: FaultFlight, true: State, t: float) -> State | None:
        made: State | None = true
        for each in (camera.state, telemetry.state):
            if each is not None and made is not None:
                made = each(flight, made, t)
        return made

    name = f"{camera.name}, {telemetry.name}"
    return replace(camera, name=name, group="combined", state=state)
