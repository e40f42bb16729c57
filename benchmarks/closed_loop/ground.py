"""The demo area: its map, and what a camera sees over it."""

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.render import ViewEffects, render_view

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
            # The demo uses all cores for the map; it needs no limit of threads.
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=dict(os.environ))
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
    def _ground(self) -> tuple[NDArray[np.uint8], Array, float]:
        """The later orthophoto (H, W, 3), its north-west corner (2,) and pixel, m."""
        grid = self.localizer.grid
        sheet = Mosaic.open([self.folder / PRESENT]).sheet(
            self.frame,
            west_m=grid.west_m,
            north_m=grid.north_m,
            width_px=grid.width_px,
            height_px=grid.height_px,
            gsd_m=grid.gsd_m,
        )
        with sheet as raster:
            rgb = np.asarray(raster.read(0, 0, grid.width_px, grid.height_px).rgb)
        return rgb, np.array([grid.west_m, grid.north_m]), grid.gsd_m

    def picture(
        self, place_en_m: Array, attitude_deg: Angles, agl_m: float, rng: np.random.Generator
    ) -> Grey:
        """What the camera sees at a place (2,), with heading, pitch and roll, and a height."""
        rgb, corner, gsd_m = self._ground
        pose = (*attitude_deg, agl_m)
        seen = render_view(CAMERA, pose, rgb, corner - place_en_m, gsd_m, EFFECTS, rng)
        return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), np.uint8)
