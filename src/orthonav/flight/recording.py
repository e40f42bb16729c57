"""What `localize` needs of a flight, whatever it was recorded with."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import Camera
from orthonav.records import Telemetry


class RecordedView(Protocol):
    """One view: its name, what was known at exposure, and its picture when it is asked for."""

    @property
    def frame(self) -> str:
        """Name of the view, unique in its flight."""

    @property
    def telemetry(self) -> Telemetry:
        """What was known at exposure."""

    @property
    def where(self) -> str:
        """Where the picture lies, for messages."""

    def grey(self) -> NDArray[np.uint8]:
        """Grey levels (H, W) uint8. Raises `FlightError` where it cannot be decoded."""


class Flight(Protocol):
    """A recorded flight: one camera and its views in the order of their time."""

    @property
    def camera(self) -> Camera:
        """The camera of every view."""

    @property
    def note(self) -> str:
        """What people should know of the flight."""

    @property
    def views(self) -> Iterable[RecordedView]:
        """The views, from the first; each is read when it comes."""

    @property
    def expected(self) -> int:
        """About how many views will come, for progress; 0 where that is not known."""


@dataclass(frozen=True)
class Retold:
    """A view of which something else was known."""

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
