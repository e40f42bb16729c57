"""Fake surroundings of a flight, beyond those of `benchmarks.fakes`: an autopilot over UDP, a
flight folder, a locator."""

import socket
import threading
import time

import cv2
import numpy as np
from benchmarks.fakes import UTC_NS, Port, S, Time
from examples.simulated_autopilot import Encoder as Autopilot

from orthonav.core.flight import FlightWriter
from orthonav.core.records import Fix
from orthonav.onboard.link import AutopilotLink
from orthonav.onboard.telemetry import TelemetryBuffer
from wire import TABLES, decode

__all__ = ["UTC_NS", "Port", "Time"]  # tests import them from here
MS = 10**6
AHEAD_NS = -90 * S  # the autopilot was switched on at 90 s of our clock


class Linked:
    """A link between a port and clocks of the test."""

    def __init__(self, **options):
        self.time, self.port, self.autopilot = Time(), Port(), Autopilot()
        self.link = AutopilotLink(self.port.open, TelemetryBuffer(), self.time.clocks, **options)

    def boot_ns(self):
        return self.time.now_ns + AHEAD_NS

    def hear(self, *frames):
        self.port.coming.extend(frames)
        return self.link.poll()


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
            self._send(self.autopilot.timesync(self.boot_ns(), message["ts1"]))
        self.heard.append(message)

    def stop(self):
        self.stopping.set()
        self.join(5)

    def named(self, name):
        return [each for each in self.heard if each["name"] == name]


def fix(lat_deg=48.0, lon_deg=2.0, confidence=0.97, std_m=2.0, heading_deg=0.0, agl_m=100.0):
    cov = np.eye(2) * std_m**2
    stated = lat_deg, lon_deg, cov, confidence, 35.0, heading_deg, agl_m
    return Fix(*stated, vel_en_mps=(0.0, 10.0))


def write_flight(folder, camera, views):
    """A flight folder of grey pictures and their telemetry."""
    folder.mkdir(exist_ok=True)
    writer = FlightWriter(folder, camera, "")
    for number, (grey, telemetry) in enumerate(views):
        frame = f"{number:03d}.png"
        writer.add_encoded(frame, cv2.imencode(".png", grey)[1].tobytes(), telemetry, None)
    writer.close()


class FakeLocator:
    """Answers every view with what `outcome(view)` gives."""

    def __init__(self, outcome=None, state="tracking"):
        self.outcome = outcome or (
            lambda view: fix(heading_deg=view.telemetry.yaw_deg, agl_m=view.telemetry.agl_m)
        )
        self.state_name, self.seen, self.bridged = state, [], []

    def locate(self, view):
        self.seen.append(view.telemetry)
        return self.outcome(view)

    def passed(self, telemetry, reason):
        self.bridged.append(telemetry)
        return fix()
