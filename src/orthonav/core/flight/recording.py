"""The interface of a recorded flight, whatever it was recorded with."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry

LONG_GAP_NS = 1_000_000_000
"""After so long without a view a velocity at one time no longer says how far the aircraft flew: it
may have turned."""


class RecordedView(Protocol):
    """One view: its name, its telemetry, and its image, which is decoded on request."""

    @property
    def frame(self) -> str:
        """Name of the view, unique in its flight."""

    @property
    def telemetry(self) -> Telemetry:
        """Telemetry of the exposure."""

    @property
    def where(self) -> str:
        """Location of the image, for messages."""

    def grey(self) -> NDArray[np.uint8]:
        """Grey levels (H, W) uint8. Raises `FlightError` where it cannot be decoded."""


class Flight(Protocol):
    """A recorded flight: one camera and its views in the order of their time."""

    @property
    def camera(self) -> Camera:
        """The camera of every view."""

    @property
    def note(self) -> str:
        """Remark on the flight, for people."""

    @property
    def views(self) -> Iterable[RecordedView]:
        """The views in order; each is read when its turn comes."""

    @property
    def expected(self) -> int:
        """Approximate number of views, for progress; 0 where it is unknown."""


@dataclass(frozen=True)
class WithTelemetry:
    """A recorded view with other telemetry."""

    view: RecordedView
    telemetry: Telemetry

    @property
    def frame(self) -> str:
        """See `RecordedView.frame`."""
        return self.view.frame

    @property
    def where(self) -> str:
        """See `RecordedView.where`."""
        return self.view.where

    def grey(self) -> NDArray[np.uint8]:
        """See `RecordedView.grey`."""
        return self.view.grey()


def fitted(camera: Camera, width_px: int, height_px: int, where: str) -> Camera:
    """`Camera.fitted`; its error says `where` the images are."""
    try:
        return camera.fitted(width_px, height_px)
    except CameraError as error:
        raise CameraError(f"{error}: {where}") from error
