"""Where the pictures of views come from, and what was known of each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import FlightError
from orthonav.flight import open_flight
from orthonav.geo.camera import Camera
from orthonav.records import Telemetry

Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Shot:
    """One view: what was known at exposure, its camera, and its picture when it is asked for.

    `load` gives (H, W) uint8, perhaps a smaller one of the same view; it raises `FlightError`.
    """

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], Grey]


class Pictures(Protocol):
    """Pictures by the name of their view."""

    def shot(self, frame: str) -> Shot:
        """Raises `FlightError` where this view has none, saying why."""
        ...


class NoPictures:
    """Only results are known."""

    def shot(self, frame: str) -> Shot:
        """See `Pictures.shot`."""
        raise FlightError("no pictures were given: name the flight with --flight")


class FolderPictures:
    """Those of a flight folder."""

    def __init__(self, path: Path) -> None:
        """Raises as `open_flight` does."""
        folder = open_flight(path)
        self._camera = folder.camera
        self._views = {view.frame: view for view in folder.views}

    def shot(self, frame: str) -> Shot:
        """See `Pictures.shot`."""
        view = self._views.get(frame)
        if view is None:
            raise FlightError("this view is not in the flight")
        return Shot(view.telemetry, self._camera, view.grey)
