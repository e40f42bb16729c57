"""A fake autopilot: sends the telemetry of a flight folder and prints what it receives.

    python examples/simulated_autopilot.py flight --url 127.0.0.1:14550

beside

    orthonav fly area.onav flight --autopilot udpin:14550

It answers TIMESYNC, sends HEARTBEAT, ATTITUDE, DISTANCE_SENSOR and LOCAL_POSITION_NED over UDP (and
GPS_RAW_INT where the folder has a `gnss.csv`), and compares the positions that it receives with the
truth of the folder, if there is one. With --messages it prints every message that it receives as a
line of JSON instead, after a first line with its start by the monotonic clock. Its clock is 0 at
the start of the folder. Needs pymavlink.
"""

import argparse
import contextlib
import csv
import json
import math
import select
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

EARTH_M = 6_371_000.0
PX4, DOWNWARD = 12, 25


def read(path, columns):
    """Columns of a CSV as arrays by name."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {
        name: np.array([float(row[name]) for row in rows]) for name in columns if name in rows[0]
    }


class Encoder:
    """Frames of what an autopilot says; those with a `key` (32 bytes) are signed."""

    def __init__(self, system=1, component=1, key=None):
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = 2**47

    def say(self, name, *values, **named):
        """Frame of a message, by its name in lower case."""
        message = getattr(mavlink, f"MAVLink_{name}_message")(*values, **named)
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def heartbeat(self, kind=PX4):
        """An autopilot that flies."""
        return self.say("heartbeat", 1, kind, 0, 0, 4, 3)

    def attitude(self, boot_ns, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
        """Yaw is sent within half a turn of north."""
        yaw = math.remainder(math.radians(yaw_deg), math.tau)
        pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
        return self.say("attitude", boot_ns // 10**6, roll, pitch, yaw, 0, 0, 0)

    def distance(self, boot_ns, metres, orientation=DOWNWARD):
        """Distance of a rangefinder along the body."""
        distance = min(round(metres * 100), 65_534)
        values = boot_ns // 10**6, 1, 65_535, distance, 0, 0, orientation, 255
        return self.say("distance_sensor", *values)

    def home(self, boot_ns, metres):
        """Height above home."""
        height_mm = round(metres * 1000)
        return self.say("global_position_int", boot_ns // 10**6, 0, 0, 0, height_mm, 0, 0, 0, 0)

    def local(self, boot_ns, velocity_ned, down=0.0):
        """Velocity and distance below the origin."""
        return self.say("local_position_ned", boot_ns // 10**6, 0, 0, down, *velocity_ned)

    def timesync(self, boot_ns, request_ns):
        """Answer to a request."""
        return self.say("timesync", boot_ns, request_ns)


class Autopilot:
    """Plays a flight folder over UDP."""

    def __init__(self, folder, address, pace, rate_hz, messages=False):
        names = ("time_s", "yaw_deg", "pitch_deg", "roll_deg", "agl_m", "vel_east_mps")
        self.telemetry = read(folder / "telemetry.csv", (*names, "vel_north_mps"))
        truth = folder / "truth.csv"
        self.truth = read(truth, ("lat_deg", "lon_deg")) if truth.is_file() else None
        self.yaw_rad = np.unwrap(np.radians(self.telemetry["yaw_deg"]))
        self.pace, self.interval_s = pace, 1 / rate_hz
        self.encoder, self.messages = Encoder(), messages
        self.mav = mavlink.MAVLink(None)
        self.mav.robust_parsing = True
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.address, self.begin_s = address, None
        self.received, self.text = [], ""
        self.gnss = []
        if (folder / "gnss.csv").is_file():
            with (folder / "gnss.csv").open(encoding="utf-8", newline="") as stream:
                self.gnss = list(csv.DictReader(stream))

    def boot_s(self):
        """Seconds since boot."""
        return time.monotonic() - self.begin_s

    def send(self, frame):
        """Send one frame."""
        with contextlib.suppress(ConnectionRefusedError):  # orthonav is not up yet
            self.socket.sendto(frame, self.address)

    def at(self, name, when_s):
        """Value of a column at a time of the folder."""
        column = self.yaw_rad if name == "yaw_rad" else self.telemetry[name]
        return float(np.interp(when_s, self.telemetry["time_s"], column))

    def send_telemetry(self):
        """Send the telemetry of the current time, in whole milliseconds as messages have it."""
        boot_ns = int(self.boot_s() * 1e3) * 10**6
        when_s = boot_ns / 1e9 * self.pace
        pitch, roll = self.at("pitch_deg", when_s), self.at("roll_deg", when_s)
        yaw = math.degrees(self.at("yaw_rad", when_s))
        self.send(self.encoder.attitude(boot_ns, yaw, pitch, roll))
        tilt = math.cos(math.radians(pitch)) * math.cos(math.radians(roll))
        self.send(self.encoder.distance(boot_ns, self.at("agl_m", when_s) / tilt))
        if "vel_east_mps" in self.telemetry:
            north, east = self.at("vel_north_mps", when_s), self.at("vel_east_mps", when_s)
            self.send(self.encoder.local(boot_ns, (north, east, 0)))

    def send_gnss(self):
        """Send the solutions of gnss.csv that are due."""
        while self.gnss and float(self.gnss[0]["time_s"]) <= self.boot_s() * self.pace:
            row = {name: float(value or "nan") for name, value in self.gnss.pop(0).items()}
            east, north = row["vel_east_mps"], row["vel_north_mps"]
            self.send(
                self.encoder.say(
                    "gps_raw_int",
                    time_usec=round(row["solved_s"] / self.pace * 1e6),
                    fix_type=int(row["fix_type"]),
                    lat=round(row["lat_deg"] * 1e7),
                    lon=round(row["lon_deg"] * 1e7),
                    alt=0,
                    eph=65_535,
                    epv=65_535,
                    vel=round(math.hypot(east, north) * 100),
                    cog=round(math.degrees(math.atan2(east, north)) % 360 * 100) % 36_000,
                    satellites_visible=int(row["satellites"]),
                    h_acc=round(row["std_m"] * 1000),
                )
            )

    def listen(self):
        """Read all available messages."""
        while True:
            try:
                data = self.socket.recv(65_536)
            except (BlockingIOError, ConnectionRefusedError):
                return
            for message in self.mav.parse_buffer(data) or []:
                self.take(message)

    def take(self, message):
        """Handle one message of orthonav."""
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self.send(self.encoder.timesync(round(self.boot_s() * 1e9), message.ts1))
        elif self.messages and kind not in ("HEARTBEAT", "BAD_DATA"):
            plain = {"at_ns": time.monotonic_ns(), "name": kind, **message.to_dict()}
            print(json.dumps(plain, default=str), flush=True)
        elif kind == "STATUSTEXT":
            # A long text comes in chunks; the last one is not full.
            self.text = self.text + message.text if message.chunk_seq else message.text
            if message.id == 0 or len(message.text) < 50:
                print(f"{self.boot_s():8.2f} s  {self.text}", flush=True)
        elif kind in ("GLOBAL_POSITION_SENSOR", "GPS_INPUT"):
            age_s = getattr(message, "processing_time", 0) / 1e6
            exposed_s = (self.boot_s() - age_s) * self.pace
            off_m = self.error_m(message.lat * 1e-7, message.lon * 1e-7, exposed_s)
            self.received.append((self.boot_s(), age_s, off_m))
            print(f"{self.boot_s():8.2f} s  {kind} {off_m:6.1f} m off, {age_s * 1e3:4.0f} ms old")

    def error_m(self, lat_deg, lon_deg, when_s):
        """Distance from the truth at a time; NaN without truth."""
        if self.truth is None:
            return math.nan
        times = self.telemetry["time_s"]
        north = lat_deg - np.interp(when_s, times, self.truth["lat_deg"])
        east = lon_deg - np.interp(when_s, times, self.truth["lon_deg"])
        east *= math.cos(math.radians(lat_deg))
        return float(np.hypot(north, east) * math.radians(EARTH_M))

    def fly(self, tail_s):
        """Run until the folder ends."""
        self.begin_s, due_s, beat_s = time.monotonic(), 0.0, 0.0
        if self.messages:
            print(json.dumps({"begin_ns": round(self.begin_s * 1e9)}), flush=True)
        end_s = float(self.telemetry["time_s"][-1]) / self.pace + tail_s
        while self.boot_s() < end_s:
            if self.boot_s() >= beat_s:
                beat_s += 1.0
                self.send(self.encoder.heartbeat())
            if self.boot_s() >= due_s:
                due_s += self.interval_s
                self.send_telemetry()
            self.send_gnss()
            self.listen()
            select.select([self.socket], [], [], 0.002)


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flight", type=Path)
    parser.add_argument("--url", default="127.0.0.1:14550", help="where orthonav listens")
    parser.add_argument("--pace", type=float, default=1.0, help="--pace of orthonav fly")
    parser.add_argument("--rate-hz", type=float, default=50.0, help="of the attitude")
    parser.add_argument(
        "--tail-s", type=float, default=2.0, help="time to continue after the end (s)"
    )
    parser.add_argument("--json", type=Path, help="write time, age and error of positions")
    parser.add_argument("--messages", action="store_true", help="print messages as JSON")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    host, _, port = options.url.rpartition(":")
    address = host, int(port)
    autopilot = Autopilot(options.flight, address, options.pace, options.rate_hz, options.messages)
    autopilot.fly(options.tail_s)
    if autopilot.received:
        _, ages_s, errors_m = np.array(autopilot.received).T
        print(
            f"{len(ages_s)} positions; age p50 {np.percentile(ages_s, 50) * 1e3:.0f} ms, "
            f"p99 {np.percentile(ages_s, 99) * 1e3:.0f} ms; "
            f"error p50 {np.nanmedian(errors_m):.1f} m, largest {np.nanmax(errors_m):.1f} m"
        )
    if options.json:
        options.json.write_text(json.dumps(autopilot.received), encoding="utf-8")


if __name__ == "__main__":
    main()
