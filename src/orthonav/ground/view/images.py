"""Images of views with their telemetry and camera, by the name of the view."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight import open_flight
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry

Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Shot:
    """One recorded view; `load` returns the image (H, W), or raises `FlightError`."""

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], Grey]


class ViewImages(Protocol):
    def shot(self, frame: str) -> Shot:
        """The view `frame`; raises `FlightError` with the reason where it has no image."""
        ...


class NoImages:
    def shot(self, frame: str) -> Shot:
        raise FlightError("there are no images; name the flight with --flight")


class FolderImages:
    def __init__(self, path: Path) -> None:
        folder = open_flight(path, images_needed=False)
        self._camera = folder.camera
        self._views = {view.frame: view for view in folder.views}

    def shot(self, frame: str) -> Shot:
        view = self._views.get(frame)
        if view is None:
            raise FlightError("this view is not in the flight")
        return Shot(view.telemetry, self._camera, view.grey)
