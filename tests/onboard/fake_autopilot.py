"""Fake surroundings of a flight: clocks, a port, an autopilot, a tracker.

What the autopilot hears is decoded by `wire`; what it says is encoded by pymavlink.
"""

import json
import math
import socket
import threading
import time
from dataclasses import asdict
from types import MappingProxyType

import cv2
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from orthonav.onboard.telemetry import Clocks
from orthonav.records import Fix
from wire import TABLES, decode

MS, S = 10**6, 10**9
UTC_NS = 1_789_000_000 * S


class Time:
    """Clocks that advance by `go` or by sleeping only."""

    def __init__(self):
        self.now_ns, self.utc_ahead_ns = 100 * S, UTC_NS
        self.clocks = Clocks(lambda: self.now_ns, lambda: self.now_ns + self.utc_ahead_ns, self.go)

    def go(self, seconds):
        self.now_ns += round(seconds * S)


class Port:
    """A port whose other end is the test."""

    def __init__(self):
        self.coming, self.gone, self.broken, self.opened, self.refuse = [], [], None, 0, False

    def open(self):
        if self.refuse:
            raise ConnectionRefusedError("nobody there")
        self.opened += 1
        return self

    def fileno(self):
        raise AssertionError("nobody should wait for this")

    def read(self):
        if self.broken:
            raise self.broken
        return self.coming.pop(0) if self.coming else b""

    def write(self, data):
        if self.broken:
            raise self.broken
        self.gone.append(bytes(data))

    def heard(self):
        pass

    def close(self):
        pass

    def sent(self, name=None):
        """What was sent so far, decoded; it is asked for once."""
        frames, self.gone = self.gone, []
        messages = [decode(f) for f in frames if int.from_bytes(f[7:10], "little") in TABLES]
        return [each for each in messages if name in (None, each["name"])]


class Autopilot:
    """Encodes what an autopilot says."""

    def __init__(self, system=1, component=1, key=None):
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = 2**47

    def say(self, name, *values, **named):
        message = getattr(mavlink, f"MAVLink_{name.lower()}_message")(*values, **named)
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def heartbeat(self, kind=12):
        return self.say("heartbeat", 1, kind, 0, 0, 4, 3)

    def attitude(self, boot_ns, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
        angles = (math.radians(angle) for angle in (roll_deg, pitch_deg, yaw_deg))
        return self.say("attitude", boot_ns // MS, *angles, 0, 0, 0)

    def distance(self, boot_ns, metres, orientation=25):
        centimetres = round(metres * 100)
        return self.say(
            "distance_sensor", boot_ns // MS, 1, 65535, centimetres, 0, 0, orientation, 255
        )

    def home(self, boot_ns, metres):
        return self.say(
            "global_position_int", boot_ns // MS, 0, 0, 0, round(metres * 1000), *[0] * 4
        )

    def local(self, boot_ns, velocity_ned, down=0.0):
        return self.say("local_position_ned", boot_ns // MS, 0, 0, down, *velocity_ned)


class LiveAutopilot(threading.Thread):
    """An autopilot over UDP in real time.

    `telemetry(autopilot, boot_ns)` gives the frames to send; `heard` has the received messages.
    """

    def __init__(self, port, telemetry, rate_hz=50.0):
        super().__init__(daemon=True)
        self.out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.out.settimeout(1 / rate_hz)
        self.address, self.telemetry = ("127.0.0.1", port), telemetry
        self.autopilot, self.heard, self.stopping = Autopilot(), [], threading.Event()
        self.begin_ns, self.mute = time.monotonic_ns(), False

    def boot_ns(self):
        return time.monotonic_ns() - self.begin_ns

    def run(self):
        due_ns = beat_ns = 0
        while not self.stopping.is_set():
            now_ns = self.boot_ns()
            if now_ns >= beat_ns and not self.mute:
                beat_ns = now_ns + S // 2
                self._send(self.autopilot.heartbeat())
            if now_ns >= due_ns and not self.mute:
                due_ns = now_ns + S // 50
                for frame in self.telemetry(self.autopilot, now_ns):
                    self._send(frame)
            self._listen()
        self.out.close()

    def _send(self, frame):
        try:
            self.out.sendto(frame, self.address)
        except ConnectionRefusedError:
            return

    def _listen(self):
        try:
            frame = self.out.recv(65536)
        except (TimeoutError, ConnectionRefusedError):
            return
        if int.from_bytes(frame[7:10], "little") not in TABLES:
            return
        message = decode(frame)
        if message["name"] == "TIMESYNC" and message["tc1"] == 0:
            self._send(self.autopilot.say("timesync", self.boot_ns(), message["ts1"]))
        self.heard.append(message)

    def stop(self):
        self.stopping.set()
        self.join(5)

    def named(self, name):
        return [each for each in self.heard if each["name"] == name]


def fix(lat_deg=48.0, lon_deg=2.0, confidence=0.97, std_m=2.0, heading_deg=0.0, agl_m=100.0):
    cov = np.eye(2) * std_m**2
    evidence = MappingProxyType({"vel_east_mps": 0.0, "vel_north_mps": 10.0})
    return Fix(lat_deg, lon_deg, cov, confidence, 35.0, heading_deg, agl_m, evidence)


def write_flight(folder, camera, views):
    """A flight folder of grey pictures and their telemetry."""
    (folder / "frames").mkdir(parents=True)
    (folder / "flight.json").write_text(json.dumps({"camera": asdict(camera)}))
    lines = ["frame,time_s,yaw_deg,pitch_deg,roll_deg,agl_m"]
    for number, (grey, telemetry) in enumerate(views):
        cv2.imwrite(str(folder / "frames" / f"{number:03d}.png"), grey)
        time_s = f"{telemetry.time_ns // S}.{telemetry.time_ns % S:09d}"
        numbers = telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg, telemetry.agl_m
        lines.append(",".join([f"{number:03d}.png", time_s, *map(repr, numbers)]))
    (folder / "telemetry.csv").write_text("\n".join(lines) + "\n")


class FakeLocator:
    """Answers every view with what `outcome(view)` gives."""

    def __init__(self, outcome=None, state="tracking"):
        self.outcome = outcome or (
            lambda view: fix(heading_deg=view.telemetry.yaw_deg, agl_m=view.telemetry.agl_m)
        )
        self.state_name, self.seen = state, []

    def locate(self, view):
        self.seen.append(view.telemetry)
        return self.outcome(view)

    def passed(self, telemetry, reason):
        return reason
