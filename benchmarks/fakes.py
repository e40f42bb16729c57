"""Fake parts of a flight in simulated time: clocks, a port, an autopilot, a camera, turbulence.

The tests of flights use them too. What arrives at the autopilot is decoded by the reader of the
tests; what it says is encoded by pymavlink (`examples/simulated_autopilot.py`).
"""

import math
import runpy
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from examples.simulated_autopilot import Encoder as Autopilot
from numpy.typing import NDArray

from orthonav.onboard.telemetry import Clocks

READER = Path(__file__).resolve().parents[1] / "tests" / "wire.py"
S = 10**9
BEGIN_NS, UTC_NS = 100 * S, 1_789_000_000 * S
"""Our clock at the start, and UTC minus our clock."""
SAMPLE_S = 0.02
"""Time step of turbulence."""
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]


class Time:
    """Clocks that advance by `go` or by sleeping only."""

    def __init__(self) -> None:
        self.now_ns, self.utc_ahead_ns = BEGIN_NS, UTC_NS
        self.clocks = Clocks(lambda: self.now_ns, lambda: self.now_ns + self.utc_ahead_ns, self.go)

    def go(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += round(seconds * S)


class Port:
    """A port whose other end has `coming` and `gone`, the frames to read and those written. It can
    `refuse` to open, and be `broken`."""

    def __init__(self) -> None:
        self.coming: list[bytes] = []
        self.gone: list[bytes] = []
        self.broken: OSError | None = None
        self.opened, self.refuse = 0, False

    def open(self) -> "Port":
        """Open it."""
        if self.refuse:
            raise ConnectionRefusedError("nobody there")
        self.opened += 1
        return self

    def fileno(self) -> int:
        """Never waited for."""
        raise AssertionError("nothing waits in simulated time")

    def read(self) -> bytes:
        """The next frame."""
        if self.broken:
            raise self.broken
        return self.coming.pop(0) if self.coming else b""

    def write(self, data: bytes) -> bool:
        """Take a frame."""
        if self.broken:
            raise self.broken
        self.gone.append(bytes(data))
        return True

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


def answers(
    autopilot: Autopilot, requests: Sequence[dict[str, Any]], now_ns: int, ahead_ns: int
) -> list[bytes]:
    """Answers to requests of TIMESYNC, with equal delays in both directions.

    `ahead_ns`: the autopilot's clock minus ours.
    """
    return [
        autopilot.timesync((now_ns + each["ts1"]) // 2 + ahead_ns, each["ts1"]) for each in requests
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
