"""Views of a flight with their truth. Imports nothing that does not fly: processes measure this."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.flight import open_flight, read_truth
from orthonav.flight.folder import read_image
from orthonav.geo.camera import Camera
from orthonav.records import Telemetry


@dataclass(frozen=True, eq=False)
class View:
    """A picture `grey` (H, W), what was told with it, and where it was taken."""

    path: Path
    grey: NDArray[np.uint8]
    telemetry: Telemetry
    truth_latlon_deg: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Flight:
    """Views of one camera."""

    folder: Path
    camera: Camera
    views: tuple[View, ...]


def read_views(folder: Path) -> tuple[Camera, Iterator[View]]:
    """The camera of a flight folder and its views, each read when it is asked for."""
    recorded = open_flight(folder)
    truth = read_truth(folder / "truth.csv")
    views = (
        View(view.path, read_image(view.path), view.telemetry, truth[view.frame])
        for view in recorded.views
    )
    return recorded.camera, views
