"""The demo area, and recorded flights of autopilots in simulation over it: what they stated, and
the views again.

A flight folder has `truth.csv`, `autopilot.csv` (what the autopilot stated, by time of arrival),
`exposures.csv` (true pose of each exposure) and `events.csv`.
"""

import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.faults import Ground
from benchmarks.looped_flight import read_rows
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Prior, Telemetry, View
from orthonav.ground.simulate.render import ViewEffects
from orthonav.onboard.telemetry import TelemetryBuffer, wxyz_of_angles

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
"""The camera of the recorded flights; it looks straight down the body, image top to the nose."""
EFFECTS = ViewEffects()
MAP, PRESENT = "area.onav", "2021-10.tif"
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Angles = tuple[float, float, float]


@dataclass(frozen=True)
class Demo:
    """Files of `orthonav demo` in a folder."""

    folder: Path

    @classmethod
    def made(cls, work: Path) -> "Demo":
        """The demo in `work`, made where it is absent (a minute or two)."""
        folder = work / "demo"
        if not (folder / MAP).is_file():
            work.mkdir(parents=True, exist_ok=True)
            command = (sys.executable, "-m", "orthonav", "demo", "--out", str(folder))
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return cls(folder)

    @cached_property
    def localizer(self) -> Localizer:
        """Places views on the map."""
        return Localizer(open_map(self.folder / MAP))

    @property
    def frame(self) -> LocalFrame:
        """The plane of the map."""
        return self.localizer.sheet.frame

    @cached_property
    def _ground(self) -> Ground:
        """The ground of the later date."""
        grid = self.localizer.grid
        return Ground(
            self.folder / PRESENT,
            self.localizer,
            corner=(grid.west_m, grid.north_m),
            size_px=(grid.width_px, grid.height_px),
            gsd_m=grid.gsd_m,
        )

    def picture(
        self, place_en_m: Array, attitude_deg: Angles, agl_m: float, rng: np.random.Generator
    ) -> Grey:
        """What the camera sees at a place (2,), with heading, pitch and roll, and a height."""
        made = self._ground.picture(place_en_m, attitude_deg, agl_m, rng, CAMERA, EFFECTS)
        return np.asarray(made, np.uint8)


GROUND_AMSL_M = 40.0
LATE_S = 0.02
"""Delay of the stated values on their way."""
LEAST_AGL_M = 100.0
"""Views from below are left out: take-off and landing."""
SHIFT_EN_M = (300.0, 0.0)
"""Where the camera looks while it shows a place 300 m east."""
PRIOR_STD_M = 100.0
ON, OFF, SHIFTED, MIRRORED, AFTER = "GNSS on", "GNSS off", "300 m east", "mirrored", "after"
PHASES = {
    "GNSS OFF": OFF,
    "300 m east": SHIFTED,
    "camera mirrored": MIRRORED,
    "camera right": AFTER,
}
"""What begins with an event that is so named."""


@dataclass(frozen=True)
class Exposure:
    """The true pose at an exposure, and what was happening (`ON` to `AFTER`)."""

    number: int
    time_s: float
    lat_deg: float
    lon_deg: float
    agl_m: float
    attitude_deg: Angles
    phase: str

    @property
    def time_ns(self) -> int:
        """Time of the exposure, ns."""
        return round(self.time_s * 1e9)


@dataclass(frozen=True)
class Recorded:
    """One flight folder."""

    folder: Path

    @cached_property
    def exposures(self) -> list[Exposure]:
        """Exposures from the start of orthonav until GNSS is on again, in order."""
        begin_s = min(time_s for time_s, _ in self._events)
        again = [time_s for time_s, event in self._events if event.startswith("GNSS ON ")]
        end_s = min(again, default=math.inf)
        made = []
        for number, row in enumerate(read_rows(self.folder / "exposures.csv")):
            value = {name: float(text) for name, text in row.items()}
            agl_m = value["amsl_m"] - GROUND_AMSL_M
            if not begin_s <= value["time_s"] < end_s or agl_m < LEAST_AGL_M:
                continue
            angles = value["yaw_deg"], value["pitch_deg"], value["roll_deg"]
            place = value["lat_deg"], value["lon_deg"]
            phase = self._phase(value["time_s"])
            made.append(Exposure(number, value["time_s"], *place, agl_m, angles, phase))
        return made

    @cached_property
    def _events(self) -> list[tuple[float, str]]:
        rows = read_rows(self.folder / "events.csv")
        return [(float(row["time_s"]), row["event"]) for row in rows]

    def _phase(self, time_s: float) -> str:
        """What was happening at a time. Before the first disturbance it is `ON` or `OFF`."""
        phase = ON
        for begin_s, event in self._events:
            if begin_s > time_s:
                break
            phase = next((to for text, to in PHASES.items() if text in event), phase)
        return phase

    @cached_property
    def truth(self) -> tuple[Array, Array]:
        """Times (N,) and true velocity (N, 2), m/s east and north."""
        rows = read_rows(self.folder / "truth.csv")
        times_s = np.array([float(row["time_s"]) for row in rows])
        east_north = [[float(row["vel_east_mps"]), float(row["vel_north_mps"])] for row in rows]
        return times_s, np.array(east_north)

    def velocity_en_mps(self, time_s: float) -> Array:
        """True velocity (2,)."""
        times_s, velocities = self.truth
        return np.array([np.interp(time_s, times_s, axis) for axis in velocities.T])

    def stated(self) -> Iterator[tuple[Exposure, Telemetry]]:
        """The exposures, with what the autopilot stated for them, as `orthonav fly` reads it."""
        buffer, rows = TelemetryBuffer(), read_rows(self.folder / "autopilot.csv")
        values = [{name: float(text) for name, text in row.items()} for row in rows]
        times_s = np.array([value["time_s"] - LATE_S for value in values])
        places = np.array([[value["lat_deg"], value["lon_deg"]] for value in values])
        given = 0
        for exposure in self.exposures:
            while given < len(values) and times_s[given] < exposure.time_s + 0.15:
                _give(buffer, round(times_s[given] * 1e9), values[given])
                given += 1
            lat, lon = (float(np.interp(exposure.time_s, times_s, axis)) for axis in places.T)
            telemetry = buffer.at(exposure.time_ns).telemetry(exposure.time_ns)
            yield exposure, replace(telemetry, prior=Prior(lat, lon, PRIOR_STD_M))

    def views(
        self, demo: Demo, cache: Path, rule: Callable[[Telemetry, bool], Telemetry]
    ) -> Iterator[tuple[Exposure, View]]:
        """Exposures and their views. `rule`: sets the deviations of the telemetry, given whether
        GNSS is on."""
        for exposure, telemetry in self.stated():
            grey = _shown(demo, exposure, cache / self.folder.name)
            yield exposure, View(grey, CAMERA, rule(telemetry, exposure.phase == ON))


def _give(buffer: TelemetryBuffer, time_ns: int, value: dict[str, float]) -> None:
    """Give the buffer what the autopilot stated at a time."""
    angles = (math.radians(value[f"{name}_deg"]) for name in ("roll", "pitch", "yaw"))
    buffer.add_attitude(time_ns, tuple(wxyz_of_angles(*angles)))
    buffer.add_height("home", time_ns, value["home_m"])
    velocity = value["vel_north_mps"], value["vel_east_mps"], value["vel_down_mps"]
    buffer.add_local(time_ns, velocity, -value["home_m"])


def _shown(demo: Demo, exposure: Exposure, cache: Path) -> Grey:
    """The picture of an exposure, rendered once."""
    path = cache / f"{exposure.number:04d}.jpg"
    if not path.is_file():
        cache.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng([1, exposure.number])
        place = demo.frame.en_from_latlon(exposure.lat_deg, exposure.lon_deg)
        if exposure.phase == SHIFTED:
            place = place + SHIFT_EN_M
        grey = demo.picture(place, exposure.attitude_deg, exposure.agl_m, rng)
        if exposure.phase == MIRRORED:
            grey = np.asarray(grey[:, ::-1])
        cv2.imwrite(str(path), grey, (cv2.IMWRITE_JPEG_QUALITY, EFFECTS.jpeg_quality))
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
