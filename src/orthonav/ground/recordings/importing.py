"""Writing a recording as a flight folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from orthonav.core.errors import FlightError
from orthonav.core.files import replacing_folder
from orthonav.core.flight import FlightWriter
from orthonav.core.flight.writer import encoded
from orthonav.core.geo.headings import seem_radians
from orthonav.ground.recordings.recording import Recording, SourceView

READABLE = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


@dataclass(frozen=True)
class Imported:
    """Number of views that were written."""

    views: int
    """All of them."""
    with_truth: int
    """Those with a true position."""
    complete: int
    """Those with all telemetry that a fix needs."""
    broken: int
    """Views left out because their image cannot be decoded, or has another size."""
    first_broken: str
    """The error of the first one of them."""
    radians: bool
    """Whether the headings look like radians."""


def import_flight(
    recording: Recording,
    out: Path,
    jpeg_quality: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Imported:
    """Write the views of `recording` as a flight folder `out`, whole or not at all.

    Encoded images are copied unchanged; others are written grey, as PNG or, with `jpeg_quality`,
    as JPEG. Views whose image cannot be decoded, or has another size than the camera, are left out
    and counted. Raises `FlightError` where none is left, `OutputError` where `out` cannot be
    written.
    """
    views = truths = complete = broken = 0
    first_broken, yaw_deg = "", []
    with replacing_folder(Path(out)) as folder:
        writer = FlightWriter(folder, recording.camera, recording.note)
        for view in recording.views:
            try:
                frame, data = _encoded_image(view, recording, jpeg_quality)
            except FlightError as error:
                broken, first_broken = broken + 1, first_broken or str(error)
                continue
            writer.add_encoded(frame, data, view.telemetry, view.truth_latlon_deg)
            views += 1
            yaw_deg.append(view.telemetry.yaw_deg)
            truths += view.truth_latlon_deg is not None
            complete += not view.telemetry.missing()
            if recording.expected:
                progress(min(1.0, (views + broken) / recording.expected))
        if views == 0:
            raise FlightError(first_broken or f"recording has no view: {recording.path}")
        writer.close()
    return Imported(views, truths, complete, broken, first_broken, seem_radians(yaw_deg))


def _encoded_image(
    view: SourceView, recording: Recording, jpeg_quality: int | None
) -> tuple[str, bytes]:
    """Name and bytes of the image as it is written, once it is decoded."""
    grey, camera = view.grey(), recording.camera
    if grey.shape != (camera.height_px, camera.width_px):
        raise FlightError(
            f"camera is {camera.width_px} x {camera.height_px} px, the image is "
            f"{grey.shape[1]} x {grey.shape[0]} px: {view.where}"
        )
    if view.data is not None and view.frame.lower().endswith(READABLE):
        return view.frame, view.data()
    suffix = ".png" if jpeg_quality is None else ".jpg"
    frame = str(PurePosixPath(view.frame).with_suffix(suffix))
    return frame, encoded(grey, frame, jpeg_quality or 0)
