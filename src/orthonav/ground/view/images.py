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
    """One recorded view; its image is loaded on demand.

    `telemetry`: at exposure; `camera`: calibration.
    `load`: returns the image (H, W) uint8, perhaps reduced; raises `FlightError`.
    """

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], Grey]


class ViewImages(Protocol):
    """A source of images."""

    def shot(self, frame: str) -> Shot:
        """The view `frame`; raises `FlightError` with the reason where it has no image."""
        ...


class NoImages:
    """No images, only results."""

    def shot(self, frame: str) -> Shot:
        """See `ViewImages.shot`."""
        raise FlightError("there are no images; name the flight with --flight")


class FolderImages:
    """Images of a flight folder."""

    def __init__(self, path: Path) -> None:
        """Raises as `open_flight` does."""
        folder = open_flight(path, images_needed=False)
        self._camera = folder.camera
        self._views = {view.frame: view for view in folder.views}

    def shot(self, frame: str) -> Shot:
        """See `ViewImages.shot`."""
        view = self._views.get(frame)
        if view is None:
            raise FlightError("this view is not in the flight")
        return Shot(view.telemetry, self._camera, view.grey)
