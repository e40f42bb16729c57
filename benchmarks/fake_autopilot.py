"""A fake autopilot process: sends the telemetry of a flight and records the messages it receives.

`python -m benchmarks.fake_autopilot FLIGHT PORT [--pace N]` prints a line of JSON for every message
that arrives, with its arrival time on the monotonic clock, which all processes of a machine share.
The reader of the tests decodes received messages from the definitions of MAVLink; it
shares nothing with what sends. Its clock since boot begins where the times of the flight do.
"""

import argparse
import contextlib
import csv
import importlib
import json
import math
import runpy
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

READER = Path(__file__).resolve().parents[1] / "tests" / "wire.py"
ATTITUDE_S = 1 / 49
"""Not a divisor of camera rates, so that exposures fall anywhere between two attitudes."""
EVERY_OTHER = 2
BEAT_S, TAIL_S = 1.0, 5.0
_PX4, _DOWNWARD = 12, 25
Array = NDArray[np.float64]


class Autopilot:
    """Plays the telemetry of a flight folder over UDP. Mutable."""

    def __init__(self, folder: Path, port: int, pace: float) -> None:
        self._telemetry = _columns(folder / "telemetry.csv")
        self._telemetry["yaw_rad"] = np.unwrap(np.radians(self._telemetry["yaw_deg"]))
        self._pace, self._address = pace, ("127.0.0.1", port)
        self._mavlink: Any = importlib.import_module("pymavlink.dialects.v20.common")
        self._mav = self._mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._decode = runpy.run_path(str(READER))["decode"]
        self._known = runpy.run_path(str(READER))["TABLES"]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._begin_ns = time.monotonic_ns()
        self._number = 0

    def run(self) -> None:
        """Send until the telemetry ends, and a little longer."""
        self._begin_ns = time.monotonic_ns()
        _say({"name": "BEGIN", "begin_ns": self._begin_ns, "utc_ahead_ns": utc_ahead_ns()})
        end_s = float(self._telemetry["time_s"][-1]) / self._pace + TAIL_S
        tell_s = beat_s = 0.0
        while (now_s := self._boot_ns() / 1e9) < end_s:
            if now_s >= beat_s:
                beat_s = now_s + BEAT_S
                self._send("heartbeat", 1, _PX4, 0, 0, 4, 3)
            if now_s >= tell_s:
                tell_s = max(tell_s + ATTITUDE_S, now_s)
                self._tell()
            left_s = min(tell_s, beat_s) - self._boot_ns() / 1e9
            if left_s > 0 and select.select([self._socket], [], [], left_s)[0]:
                self._listen()

    def _boot_ns(self) -> int:
        return time.monotonic_ns() - self._begin_ns

    def _send(self, name: str, *values: Any) -> None:
        message = getattr(self._mavlink, f"MAVLink_{name}_message")(*values)
        with contextlib.suppress(ConnectionRefusedError):  # the receiver is not up yet
            self._socket.sendto(message.pack(self._mav), self._address)
        self._mav.seq = (self._mav.seq + 1) % 256

    def _at(self, name: str, when_s: float) -> float:
        return float(np.interp(when_s, self._telemetry["time_s"], self._telemetry[name]))

    def _tell(self) -> None:
        """Telemetry at the current time, rounded to the millisecond of the message."""
        boot_ms = self._boot_ns() // 10**6
        when_s = boot_ms / 1e3 * self._pace
        pitch, roll = (math.radians(self._at(name, when_s)) for name in ("pitch_deg", "roll_deg"))
        yaw = math.remainder(self._at("yaw_rad", when_s), math.tau)
        self._send("attitude", boot_ms, roll, pitch, yaw, 0, 0, 0)
        self._number += 1
        if self._number % EVERY_OTHER:
            return
        slant_m = self._at("agl_m", when_s) / (math.cos(pitch) * math.cos(roll))
        slant_cm = round(slant_m * 100)
        self._send("distance_sensor", boot_ms, 1, 65_535, slant_cm, 0, 0, _DOWNWARD, 255)
        if "vel_east_mps" in self._telemetry:
            north, east = self._at("vel_north_mps", when_s), self._at("vel_east_mps", when_s)
            self._send("local_position_ned", boot_ms, 0, 0, 0, north, east, 0)

    def _listen(self) -> None:
        """All messages received so far; a datagram holds one message."""
        while True:
            try:
                frame = self._socket.recv(65_536)
            except (BlockingIOError, ConnectionRefusedError):
                return
            at_ns = time.monotonic_ns()
            if int.from_bytes(frame[7:10], "little") not in self._known:
                continue
            message = self._decode(frame)
            if message["name"] == "TIMESYNC":
                if message["tc1"] == 0:
                    self._send("timesync", self._boot_ns(), message["ts1"])
            elif message["name"] != "HEARTBEAT":
                _say({"at_ns": at_ns, **message})


def utc_ahead_ns() -> int:
    """UTC minus the monotonic clock, from the fastest of several readings."""
    readings = []
    for _ in range(20):
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


def _columns(path: Path) -> dict[str, Array]:
    """The columns of numbers of a CSV."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = [name for name in rows[0] if name != "frame"]
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


def _say(message: dict[str, Any]) -> None:
    print(json.dumps(message, default=_text), flush=True)


def _text(value: bytes) -> str:
    return value.rstrip(b"\0").decode("ascii", "replace")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fake_autopilot")
    parser.add_argument("flight", type=Path)
    parser.add_argument("port", type=int)
    parser.add_argument("--pace", type=float, default=1.0)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    Autopilot(options.flight, options.port, options.pace).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
