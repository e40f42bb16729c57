"""The faults of the fault suite, by name."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.fakes import Grey
from benchmarks.fault_flights import (
    BEGIN_S,
    STATED_S,
    Fault,
    FaultFlight,
    State,
    combined,
    telemetry_frames,
)

FROZEN_NOISE = 3.0
"""Grey levels, standard deviation."""
JUMP_S = 30.0
StateOf = Callable[[FaultFlight, State, float], State]
BOOTED_BEFORE_NS = 20 * 10**9
"""The other vehicle was switched on so long before: its times of the same moment are greater."""


def _noise(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    rough = flight.rng.normal(0, 1, (15, 20)).astype(np.float32)
    fine = flight.rng.normal(0, 15, grey.shape)
    return _levels(cv2.resize(rough, grey.shape[::-1]) * 30 + 120 + fine)


def _cloud(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """Bright, soft, without structure of the ground; it drifts."""
    rows, cols = np.indices(grey.shape, np.float32)
    waves = np.sin((rows + 40 * t) / 37) + np.sin((cols - 25 * t) / 53 + rows / 90)
    return _levels(205 + 12 * waves + flight.rng.normal(0, 2, grey.shape))


def _half_cloud(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    made = grey.copy()
    half = grey.shape[1] // 2
    made[:, :half] = _cloud(flight, grey, t)[:, :half]
    return made


def _shadow(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """Shadows of clouds with sharp edges that pass over the view."""
    rows, cols = np.indices(grey.shape, np.float32)
    dark = np.sin((cols + 60 * t) / 23) + np.sin((rows - 45 * t) / 31 + cols / 71) > 0.4
    return _levels(grey * np.where(dark, 0.35, 1.0))


def _snow(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """The contrast of the ground is a tenth, brightness is high."""
    return _levels(215 + 0.1 * (grey - 110.0) + flight.rng.normal(0, 2, grey.shape))


def _frozen(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    still = flight.seen_at(BEGIN_S + flight.fault_s[0])
    return _levels(still + flight.rng.normal(0, FROZEN_NOISE, grey.shape))


def _half_frame(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """The lower half is missing, as where a decoder lost data."""
    made = grey.copy()
    made[grey.shape[0] // 2 :] = 128
    return made


def _torn(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """The lower half belongs to an image of a second before."""
    made = grey.copy()
    half = grey.shape[0] // 2
    made[half:] = flight.seen_at(BEGIN_S + flight.since_s - STATED_S - 1.0)[half:]
    return made


def _still(flight: FaultFlight, grey: Grey, t: float) -> Grey:
    """The same image again and again."""
    return flight.seen_at(BEGIN_S + flight.fault_s[0], np.random.default_rng(0))


def _levels(values: NDArray[Any]) -> Grey:
    return np.asarray(np.clip(values, 0, 255), np.uint8)


CAMERA_FAULTS = (
    Fault("2 s late from the start", "camera", 30.0, from_start=True, delay_s=lambda n, t: 2.0),
    Fault("8 s late from the start", "camera", 30.0, from_start=True, delay_s=lambda n, t: 8.0),
    Fault(
        "latency not stated, 0.4 s",
        "camera",
        40.0,
        from_start=True,
        delay_s=lambda n, t: 0.4,
        stated_s=None,
    ),
    Fault(
        "stalls for 3 s, then 3 s late",
        "camera",
        15.0,
        arrives=lambda n, t: t > 3.0,
        delay_s=lambda n, t: STATED_S + 3.0,
    ),
    Fault("2 s late without a gap", "camera", 15.0, delay_s=lambda n, t: 2.0),
    Fault("latency grows by 0.1 s/s", "camera", 15.0, delay_s=lambda n, t: STATED_S + 0.1 * t),
    Fault("latency grows by 0.02 s/s", "camera", 40.0, delay_s=lambda n, t: STATED_S + 0.02 * t),
    Fault("reordered", "camera", 15.0, delay_s=lambda n, t: STATED_S + (0.0, 0.4, 0.2)[n % 3]),
    Fault("mirrored", "camera", picture=lambda f, grey, t: np.ascontiguousarray(grey[:, ::-1])),
    Fault(
        "rotated by 180 deg",
        "camera",
        picture=lambda f, grey, t: np.ascontiguousarray(grey[::-1, ::-1]),
    ),
    Fault("frozen", "camera", picture=_still),
    Fault("frozen with noise", "camera", 15.0, picture=_frozen),
    Fault("noise", "camera", picture=_noise),
    Fault("cloud", "camera", picture=_cloud),
    Fault("black", "camera", picture=lambda f, grey, t: np.zeros_like(grey)),
    Fault("white", "camera", picture=lambda f, grey, t: np.full_like(grey, 255)),
    Fault("lower half missing", "camera", picture=_half_frame),
    Fault("lower half 1 s old", "camera", picture=_torn),
    Fault("0.5 Hz", "camera", 20.0, arrives=lambda n, t: n % 10 == 0),
)


def _changed(**fields: Callable[[State, float], float]) -> StateOf:
    """The state with these fields replaced, each by a function of it and the time."""

    def made(_: FaultFlight, state: State, t: float) -> State:
        return replace(state, **{name: of(state, t) for name, of in fields.items()})

    return made


def _unknown(_: State, t: float) -> float:
    return math.nan


def _attitude_of(flight: FaultFlight, state: State, seconds: float) -> State:
    """The attitude of `seconds` ago, everything else of now."""
    before = flight.path.reported(BEGIN_S + flight.since_s - seconds)
    return replace(state, yaw=before.yaw, pitch=before.pitch, roll=before.roll)


def _autopilot_jumps(flight: FaultFlight) -> None:
    flight.boot_ahead_ns += round(JUMP_S * 1e9)


def _autopilot_restarts(flight: FaultFlight) -> None:
    flight.boot_ahead_ns = -flight.time.now_ns


def _computer_jumps(flight: FaultFlight) -> None:
    flight.time.utc_ahead_ns += round(3600 * 1e9)


def _elsewhere(state: State) -> State:
    return State(state.yaw + 120, -3.0, 10.0, -state.north, 12.0, 0.4 * state.height)


def _other_system(flight: FaultFlight, state: State, boot_ns: int) -> list[bytes]:
    made = telemetry_frames(flight.other, _elsewhere(state), boot_ns + BOOTED_BEFORE_NS)
    return [flight.other.heartbeat(), *made]


def _same_system(flight: FaultFlight, state: State, boot_ns: int) -> list[bytes]:
    return telemetry_frames(flight.autopilot, _elsewhere(state), boot_ns + BOOTED_BEFORE_NS)


TELEMETRY_FAULTS = (
    Fault("heading off by 86 deg", "telemetry", state=_changed(yaw=lambda s, t: s.yaw + 86)),
    Fault("heading off by 180 deg", "telemetry", state=_changed(yaw=lambda s, t: s.yaw + 180)),
    Fault(
        "heading drifts by 2 deg/s",
        "telemetry",
        30.0,
        state=_changed(yaw=lambda s, t: s.yaw + 2 * t),
    ),
    Fault("height times 0.5", "telemetry", state=_changed(height=lambda s, t: 0.5 * s.height)),
    Fault("height times 2", "telemetry", state=_changed(height=lambda s, t: 2 * s.height)),
    Fault(
        "velocity reversed",
        "telemetry",
        state=_changed(north=lambda s, t: -s.north, east=lambda s, t: -s.east),
    ),
    Fault("velocity 3 m/s off", "telemetry", 20.0, state=_changed(north=lambda s, t: s.north + 3)),
    Fault("no velocity", "telemetry", 20.0, state=_changed(north=_unknown, east=_unknown)),
    Fault("attitude frozen", "telemetry", 15.0, state=_attitude_of),
    Fault("attitude 1 s late", "telemetry", 15.0, state=lambda f, s, t: _attitude_of(f, s, 1.0)),
    Fault(
        "no telemetry for 1 s of 2",
        "telemetry",
        20.0,
        state=lambda f, s, t: None if t % 2 < 1 else s,
    ),
    Fault("no telemetry", "telemetry", state=lambda f, state, t: None),
    Fault("autopilot's clock set by 30 s", "telemetry", begins=_autopilot_jumps),
    Fault("autopilot restarted", "telemetry", begins=_autopilot_restarts),
    Fault("computer's clock set by 1 h", "telemetry", begins=_computer_jumps),
    Fault("another vehicle, other system id", "telemetry", others=_other_system),
    Fault("another vehicle, same system id", "telemetry", others=_same_system),
)
FAULTS_BY_NAME = {each.name: each for each in (*CAMERA_FAULTS, *TELEMETRY_FAULTS)}
BLIND = ("mirrored", "noise", "cloud", "heading off by 86 deg")
MISLEADING = ("velocity reversed", "velocity 3 m/s off")
COMBINED_FAULTS = tuple(
    combined(FAULTS_BY_NAME[blind], FAULTS_BY_NAME[misleading])
    for blind in BLIND
    for misleading in MISLEADING
)
GROUND_FAULTS = (
    Fault("map shifted by 60 m", "map", 20.0, ground_en_m=(60.0, 0.0), detectable=False),
    Fault("leaves the map", "map", 60.0, leaves_map=True),
    Fault("shadows of clouds", "ground", 20.0, picture=_shadow),
    Fault("snow", "ground", 20.0, picture=_snow),
    Fault("half cloud", "ground", 20.0, picture=_half_cloud),
)
"""Further ones need a map of their own: `benchmarks.faults`."""
