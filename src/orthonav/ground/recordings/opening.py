"""Detection of the kind of a recording, and opening it."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import require_file
from orthonav.core.flight import FlightFolder, open_flight, read_truth
from orthonav.core.flight.source_options import SourceOptions
from orthonav.ground.recordings.flightlog import is_flight_log, open_flight_log
from orthonav.ground.recordings.image_table import is_image_table
from orthonav.ground.recordings.photo_files import is_photo, photo_paths
from orthonav.ground.recordings.photos import open_photos
from orthonav.ground.recordings.recording import (
    Recording,
    SourceView,
    given_camera,
    time_warnings,
    with_options,
)
from orthonav.ground.recordings.ros import open_ros
from orthonav.ground.recordings.ros_files import METADATA, bag_suffix, storage_files
from orthonav.ground.recordings.video import open_video

_VIDEO_STARTS = (b"\x1aE\xdf\xa3", b"\0\0\1\xba", b"\0\0\1\xb3", b"FLV\1")
_TS_PACKET_BYTES = 188


def open_source(path: Path | Sequence[Path], options: SourceOptions | None = None) -> Recording:
    """Open a recording: a flight folder, photographs, a video, ROS messages, or a flight log.

    Photographs are a folder, a table of images beside them, or one or more files. Raises
    `MissingFileError`, `FlightError`, `CameraError` or `MissingExtraError`.
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    path, options = paths[0], options or SourceOptions()
    for each in paths:
        if not each.exists():
            raise MissingFileError(f"source does not exist: {each}")
    if len(paths) > 1:
        return open_photos(paths, options)
    kind = options.kind or source_kind(path)
    if kind == "flight" and not path.is_dir():
        raise FlightError(f"expected a folder for kind {kind}, got a file: {path}")
    if kind == "video" and not path.is_file():
        raise FlightError(f"expected a file for kind video, got a folder: {path}")
    if kind == "flight":
        return _flight(open_flight(path, images_needed=not options.skip_bad_images), options)
    if kind == "photos":
        return open_photos(paths, options)
    if kind == "log":
        return open_flight_log(path, options)
    return open_video(path, options) if kind == "video" else open_ros(path, options)


def source_kind(path: Path) -> str:
    """`flight`, `photos`, `video`, `ros` or `log`, by content. Raises `FlightError` for others."""
    path = Path(path)
    if path.is_dir():
        return _folder_kind(path)
    if path.stat().st_size == 0:
        raise FlightError(f"source is empty: {path}")
    require_file(path, "source")
    if is_flight_log(path):
        return "log"
    if bag_suffix(path) is not None:
        return "ros"
    if is_photo(path) or is_image_table(path):
        return "photos"
    if _is_video(path):
        return "video"
    raise FlightError(
        "expected photographs (JPEG, PNG, TIFF), a table of them by file name, a video (MP4, MOV, "
        "AVI, MKV, MPEG) or a ROS recording (.bag, .db3, .mcap); a log of an autopilot belongs to "
        f"--telemetry: {path}"
    )


def _folder_kind(path: Path) -> str:
    telemetry, images = path / "telemetry.csv", path / "frames"
    if (path / "flight.json").exists() or (telemetry.exists() and images.exists()):
        return "flight"
    if (path / METADATA).exists():
        return "ros"
    if is_flight_log(path):
        return "log"
    if photo_paths(path):
        return "photos"
    if storage_files(path):
        return "ros"
    raise FlightError(
        "expected a flight folder (flight.json), photographs, a ROS 2 bag (.mcap, .db3) or a "
        f"flight log: {path}"
    )


def _is_video(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(_TS_PACKET_BYTES + 1)
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free"):  # ISO base media, QuickTime
        return True
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return True
    transport = len(head) > _TS_PACKET_BYTES and head[0] == head[_TS_PACKET_BYTES] == 0x47
    return transport or head.startswith(_VIDEO_STARTS)


def _flight(folder: FlightFolder, options: SourceOptions) -> Recording:
    """A flight folder as a recording; truth may become the prior, the camera may be replaced."""
    if options.telemetry is not None:
        raise FlightError(f"a flight folder has its own telemetry; omit --telemetry: {folder.path}")
    own = folder.camera
    camera = given_camera(options, own.width_px, own.height_px, str(folder.path)) or own
    path, truth, warnings = folder.path / "truth.csv", {}, []
    try:
        truth = read_truth(path) if path.exists() else {}
    except FlightError as error:  # a flight can be localized without truth
        warnings.append(f"ground truth is ignored: {error}")
    return Recording(
        kind="flight",
        path=folder.path,
        camera=camera,
        note=folder.note,
        expected=len(folder.views),
        stream=partial(_flight_views, folder, truth, options),
        warnings=(*warnings, *time_warnings(view.telemetry.time_ns for view in folder.views)),
    )


def _flight_views(
    folder: FlightFolder, truth: dict[str, tuple[float, float]], options: SourceOptions
) -> Iterator[SourceView]:
    for view in folder.views:
        known = truth.get(view.frame)
        yield SourceView(
            frame=view.frame,
            telemetry=with_options(view.telemetry, known, options),
            truth_latlon_deg=known,
            where=view.where,
            load=view.grey,
            data=view.path.read_bytes,
        )
