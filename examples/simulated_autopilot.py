"""A fake autopilot: sends the telemetry of a flight folder and prints what it receives.

    python examples/simulated_autopilot.py flight --url 127.0.0.1:14550

beside

    orthonav fly area.onav flight --file-clock autopilot --autopilot udpin:14550

It answers TIMESYNC, sends HEARTBEAT, ATTITUDE, DISTANCE_SENSOR and LOCAL_POSITION_NED over UDP (and
GPS_RAW_INT where the folder has a `gnss.csv`), and compares the positions that it receives with the
truth of the folder, if there is one. Its clock is 0 at the start of the folder. Needs pymavlink.
"""

import argparse
import contextlib
import csv
import json
import math
import socket
import time
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

EARTH_M = 6_371_000.0


def read(path, columns):
    """Columns of a CSV as arrays by name."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {
        name: np.array([float(row[name]) for row in rows]) for name in columns if name in rows[0]
    }


class Autopilot:
    """Plays a flight folder over UDP."""

    def __init__(self, folder, address, pace, rate_hz):
        names = ("time_s", "yaw_deg", "pitch_deg", "roll_deg", "agl_m", "vel_east_mps")
        self.telemetry = read(folder / "telemetry.csv", (*names, "vel_north_mps"))
        truth = folder / "truth.csv"
        self.truth = read(truth, ("lat_deg", "lon_deg")) if truth.is_file() else None
        self.yaw_rad = np.unwrap(np.radians(self.telemetry["yaw_deg"]))
        self.pace, self.interval_s = pace, 1 / rate_hz
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
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

    def send(self, message):
        """Send one message."""
        with contextlib.suppress(ConnectionRefusedError):  # orthonav is not up yet
            self.socket.sendto(message.pack(self.mav), self.address)
        self.mav.seq = (self.mav.seq + 1) % 256

    def at(self, name, when_s):
        """Value of a column at a time of the folder."""
        column = self.yaw_rad if name == "yaw_rad" else self.telemetry[name]
        return float(np.interp(when_s, self.telemetry["time_s"], column))

    def send_telemetry(self):
        """Send the telemetry of the current time."""
        boot_s = self.boot_s()
        when_s, boot_ms = boot_s * self.pace, round(boot_s * 1000)
        pitch, roll = (math.radians(self.at(n, when_s)) for n in ("pitch_deg", "roll_deg"))
        yaw = math.remainder(self.at("yaw_rad", when_s), math.tau)
        self.send(mavlink.MAVLink_attitude_message(boot_ms, roll, pitch, yaw, 0, 0, 0))
        slant_m = self.at("agl_m", when_s) / (math.cos(pitch) * math.cos(roll))
        distance = min(round(slant_m * 100), 65_534)
        self.send(
            mavlink.MAVLink_distance_sensor_message(boot_ms, 1, 65_535, distance, 0, 0, 25, 255)
        )
        if "vel_east_mps" in self.telemetry:
            north, east = self.at("vel_north_mps", when_s), self.at("vel_east_mps", when_s)
            self.send(mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, 0, north, east, 0))

    def send_gnss(self):
        """Send the solutions of gnss.csv that are due."""
        while self.gnss and float(self.gnss[0]["time_s"]) <= self.boot_s() * self.pace:
            row = {name: float(value or "nan") for name, value in self.gnss.pop(0).items()}
            east, north = row["vel_east_mps"], row["vel_north_mps"]
            self.send(
                mavlink.MAVLink_gps_raw_int_message(
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
            boot_ns = round(self.boot_s() * 1e9)
            self.send(mavlink.MAVLink_timesync_message(boot_ns, message.ts1))
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
        end_s = float(self.telemetry["time_s"][-1]) / self.pace + tail_s
        while self.boot_s() < end_s:
            if self.boot_s() >= beat_s:
                beat_s += 1.0
                self.send(mavlink.MAVLink_heartbeat_message(1, 12, 0, 0, 4, 3))
            if self.boot_s() >= due_s:
                due_s += self.interval_s
                self.send_telemetry()
            self.send_gnss()
            self.listen()
            time.sleep(0.002)


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
    options = parser.parse_args()
    host, _, port = options.url.rpartition(":")
    autopilot = Autopilot(options.flight, (host, int(port)), options.pace, options.rate_hz)
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
