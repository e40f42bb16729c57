"""Recorded flights of autopilots located again: their own telemetry, views from the true poses.

The autopilot flew on what orthonav 2bf6196 sent, so its errors of attitude and velocity are those
of a closed loop; what is located now is not fed back. A flight folder has `truth.csv`,
`autopilot.csv` (what the autopilot stated, by time of arrival), `exposures.csv` (true pose of each
exposure) and `events.csv`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.faults import Ground
from benchmarks.record import read_rows
from benchmarks.scenes import PAST, PRESENT, map_of
from orthonav.cli.demo import IMAGERY
from orthonav.core.geo.attitude import wxyz_of_angles
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Prior, Telemetry, View
from orthonav.ground.simulate.render import ViewEffects
from orthonav.onboard.telemetry import ABSOLUTE, FIX_3D, Aiding, TelemetryBuffer

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
"""The camera of the recorded flights; it looks straight down the body, image top to the nose."""
EFFECTS = ViewEffects()
Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Angles = tuple[float, float, float]


@dataclass(frozen=True)
class Area:
    """A map and an orthophoto of another date, which the camera sees.

    `mount_deg`: unreported pitch and roll of the camera in the body.
    """

    map_path: Path
    seen: Path
    mount_deg: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def demo(cls, work: Path) -> "Area":
        """The area of `orthonav demo`, over whose level ground the flights were flown."""
        built = map_of(IMAGERY / f"{PAST}.tif", work, dem=IMAGERY / "dem.tif")
        return cls(built, IMAGERY / f"{PRESENT}.tif")

    @cached_property
    def localizer(self) -> Localizer:
        return Localizer(open_map(self.map_path))

    @property
    def frame(self) -> LocalFrame:
        return self.localizer.sheet.frame

    @property
    def radius_m(self) -> float:
        """Within which a fix is correct."""
        assert self.localizer.registration is not None
        return self.localizer.registration.radius_m

    @cached_property
    def _ground(self) -> Ground:
        return Ground(self.seen, self.localizer)

    def picture(
        self, place_en_m: Array, attitude_deg: Angles, agl_m: float, rng: np.random.Generator
    ) -> Grey:
        """What the camera sees at a place (2,), with heading, pitch and roll, and a height."""
        yaw, pitch, roll = attitude_deg
        angles = yaw, pitch + self.mount_deg[0], roll + self.mount_deg[1]
        return self._ground.picture(place_en_m, angles, agl_m, rng, CAMERA, EFFECTS)


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
        for index, row in enumerate(read_rows(self.folder / "exposures.csv")):
            value = {name: float(text) for name, text in row.items()}
            agl_m = value["amsl_m"] - GROUND_AMSL_M
            if not begin_s <= value["time_s"] < end_s or agl_m < LEAST_AGL_M:
                continue
            angles = value["yaw_deg"], value["pitch_deg"], value["roll_deg"]
            place = value["lat_deg"], value["lon_deg"]
            phase = self._phase(value["time_s"])
            made.append(Exposure(index, value["time_s"], *place, agl_m, angles, phase))
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

    def stated(self) -> Iterator[tuple[Exposure, Telemetry]]:
        """The exposures, with what the autopilot stated for them, as `orthonav fly` reads it."""
        buffer = TelemetryBuffer()
        rows = read_rows(self.folder / "autopilot.csv")
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

    def view(self, area: Area, cache: Path, exposure: Exposure, telemetry: Telemetry) -> View:
        """The view of an exposure; its picture is rendered once and kept in a folder."""
        path = cache / self.folder.name / f"{exposure.number:04d}.jpg"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            rng = np.random.default_rng([1, exposure.number])
            place = area.frame.en_from_latlon(exposure.lat_deg, exposure.lon_deg)
            if exposure.phase == SHIFTED:
                place = place + SHIFT_EN_M
            grey = area.picture(place, exposure.attitude_deg, exposure.agl_m, rng)
            if exposure.phase == MIRRORED:
                grey = np.asarray(grey[:, ::-1])
            cv2.imwrite(str(path), grey, (cv2.IMWRITE_JPEG_QUALITY, EFFECTS.jpeg_quality))
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        return View(grey, CAMERA, telemetry)


def _give(buffer: TelemetryBuffer, time_ns: int, value: dict[str, float]) -> None:
    """Give the buffer what the autopilot stated at a time."""
    angles = (math.radians(value[f"{name}_deg"]) for name in ("yaw", "pitch", "roll"))
    buffer.add_attitude(time_ns, wxyz_of_angles(list(angles)).tolist())
    buffer.add_height("home", time_ns, value["home_m"])
    velocity = value["vel_north_mps"], value["vel_east_mps"], value["vel_down_mps"]
    buffer.add_local(time_ns, velocity, -value["home_m"])


def stated(autopilot: str, telemetry: Telemetry, gnss: bool) -> Telemetry:
    """Telemetry with the deviations that `orthonav fly` states for an autopilot (px4, ardupilot);
    `gnss`: whether GNSS aids it."""
    aiding = Aiding()
    aiding.status(ABSOLUTE if gnss else 0, 0, ardupilot=autopilot == "ardupilot")
    if gnss:
        aiding.receiver(FIX_3D, 0)
    vel_std_mps, tilt_std_deg = aiding.stds(0)
    known = math.isfinite(vel_std_mps)
    return replace(telemetry, tilt_std_deg=tilt_std_deg, vel_std_mps=vel_std_mps if known else None)
