"""The interface of a recorded flight, whatever it was recorded with."""

from collections.abc import Callable, Iterable
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
NO_SOURCE = "none"


@dataclass(frozen=True, eq=False)
class RecordedView:
    """One view of a recorded flight; its image is decoded on request."""

    frame: str  # name, unique in its flight, with the suffix of the format of its image
    telemetry: Telemetry  # telemetry of the exposure
    truth_latlon_deg: tuple[float, float] | None  # true position, where it is known
    where: str  # location of the image, for messages; its path where it is a file
    load: Callable[[], NDArray[np.uint8]]  # decodes the image
    data: Callable[[], bytes] | None = None
    """Returns the image as it was encoded; None where it was recorded unencoded."""

    def grey(self) -> NDArray[np.uint8]:
        """Grey levels (H, W) uint8. Raises `FlightError` where it cannot be decoded."""
        return self.load()


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


def fitted(camera: Camera, width_px: int, height_px: int, where: str) -> Camera:
    """`Camera.fitted`; its error says `where` the images are."""
    try:
        return camera.fitted(width_px, height_px)
    except CameraError as error:
        raise CameraError(f"{error}: {where}") from error


def chosen(role: str, used: str, others: Iterable[str], why: str) -> str:
    """Which of several sources is used for a role, and why not the others."""
    unused = ", ".join(others)
    if used == NO_SOURCE:
        return f"{role}: none fits of {unused}; --topic {role}=NAME selects one"
    return f"{role}: using {used}{f', not {unused}' * bool(unused)}: {why}"
