"""Fake parts of a flight in simulated time: clocks, a port, an autopilot, a camera, turbulence.

The tests of flights use them too. What arrives at the autopilot is decoded by the reader of the
tests; what it says is encoded by pymavlink.
"""

import importlib
import math
import runpy
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.fake_autopilot import READER
from orthonav.onboard.telemetry import Clocks

MS, S = 10**6, 10**9
BEGIN_NS, UTC_NS = 100 * S, 1_789_000_000 * S
"""Our clock at the start, and UTC minus our clock."""
SAMPLE_S = 0.02
"""Time step of turbulence."""
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Velocity = tuple[float, float, float]


class Time:
    """Clocks that advance by `go` or by sleeping only."""

    def __init__(self) -> None:
        self.now_ns, self.utc_ahead_ns = BEGIN_NS, UTC_NS
        self.clocks = Clocks(lambda: self.now_ns, lambda: self.now_ns + self.utc_ahead_ns, self.go)

    def go(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += round(seconds * S)


class Port:
    """A port whose other end has `coming` and `gone`, the frames to read and those written."""

    def __init__(self) -> None:
        self.coming: list[bytes] = []
        self.gone: list[bytes] = []

    def open(self) -> "Port":
        """Open it."""
        return self

    def fileno(self) -> int:
        """Never waited for."""
        raise AssertionError("nothing waits in simulated time")

    def read(self) -> bytes:
        """The next frame."""
        return self.coming.pop(0) if self.coming else b""

    def write(self, data: bytes) -> None:
        """Take a frame."""
        self.gone.append(bytes(data))

    def heard(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""

    def sent(self, name: str | None = None) -> list[dict[str, Any]]:
        """Messages of a name, or all, since this was last asked for."""
        frames, self.gone = self.gone, []
        known, decode = _reader()
        messages = [decode(f) for f in frames if int.from_bytes(f[7:10], "little") in known]
        return [each for each in messages if name in (None, each["name"])]


@cache
def _reader() -> tuple[dict[int, Any], Callable[[bytes], dict[str, Any]]]:
    """Message ids that the reader of the tests knows, and its function."""
    made = runpy.run_path(str(READER))
    return made["TABLES"], made["decode"]


class Autopilot:
    """Encodes what an autopilot says."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self._mavlink: Any = importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
        self.mav = self._mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def say(self, name: str, *values: Any, **named: Any) -> bytes:
        """A frame."""
        message = getattr(self._mavlink, f"MAVLink_{name}_message")(*values, **named)
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def heartbeat(self, kind: int = 12) -> bytes:
        """Of an autopilot that flies; `kind` 12 is PX4."""
        return self.say("heartbeat", 1, kind, 0, 0, 4, 3)

    def attitude(
        self, boot_ns: int, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
    ) -> bytes:
        """Yaw is sent within half a turn of north."""
        yaw = math.remainder(math.radians(yaw_deg), math.tau)
        pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
        return self.say("attitude", boot_ns // MS, roll, pitch, yaw, 0, 0, 0)

    def home(self, boot_ns: int, metres: float) -> bytes:
        """Height above home."""
        height_mm = round(metres * 1000)
        return self.say("global_position_int", boot_ns // MS, 0, 0, 0, height_mm, 0, 0, 0, 0)

    def local(self, boot_ns: int, velocity_ned: Velocity, down: float = 0.0) -> bytes:
        """Velocity and distance below the origin."""
        return self.say("local_position_ned", boot_ns // MS, 0, 0, down, *velocity_ned)

    def answers(
        self, requests: Sequence[dict[str, Any]], now_ns: int, ahead_ns: int
    ) -> list[bytes]:
        """Answers to requests of TIMESYNC, with equal delays in both directions.

        `ahead_ns`: the autopilot's clock minus ours.
        """
        return [
            self.say("timesync", (now_ns + each["ts1"]) // 2 + ahead_ns, each["ts1"])
            for each in requests
        ]


class Stream:
    """A capture of a live camera; `seen` gives the image that arrives."""

    def __init__(self, seen: Callable[[], Grey]) -> None:
        self._seen = seen

    def isOpened(self) -> bool:  # noqa: N802 - a name of OpenCV
        """Always."""
        return True

    def grab(self) -> bool:
        """Always."""
        return True

    def retrieve(self) -> tuple[bool, Grey]:
        """The image."""
        return True, self._seen()

    def get(self, _: int) -> float:
        """No timestamps."""
        return 0.0

    def set(self, *_: Any) -> None:
        """Nothing to do."""

    def release(self) -> None:
        """Nothing to do."""


def wandering(rng: np.random.Generator, count: int, std: float, time_s: float) -> Array:
    """Smooth noise (count,) of a standard deviation and a time constant, `SAMPLE_S` apart."""
    decay = math.exp(-SAMPLE_S / time_s)
    out, value, slope = np.zeros(count), 0.0, 0.0
    for i, each in enumerate(rng.standard_normal(count)):
        slope = decay * slope + (1 - decay) * each
        value = decay * value + (1 - decay) * slope
        out[i] = value
    return std * out / max(float(out.std()), 1e-12)
