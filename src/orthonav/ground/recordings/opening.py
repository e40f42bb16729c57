"""Opening a recording of any kind, and importing it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import replacing_folder, require_file
from orthonav.core.flight import FlightFolder, FlightWriter, open_flight, read_truth
from orthonav.core.flight.folder import encoded
from orthonav.core.flight.recording import RecordedView
from orthonav.core.geo.camera_files import masked
from orthonav.core.geo.headings import seem_radians
from orthonav.ground.recordings.flightlog import is_flight_log, open_flight_log
from orthonav.ground.recordings.image_table import is_image_table
from orthonav.ground.recordings.photos import SUFFIXES, is_photo, open_photos, photo_paths
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    given_camera,
    time_warnings,
    with_options,
)
from orthonav.ground.recordings.ros import METADATA, bag_suffix, open_ros, storage_files
from orthonav.ground.recordings.video import open_video


def open_source(path: Path | Sequence[Path], options: SourceOptions | None = None) -> Recording:
    """Open a recording: a flight folder, photographs, a video, ROS messages, or a flight log.

    Photographs are a folder, a table of images beside them, or one or more files. Raises
    `MissingFileError`, `FlightError`, `CameraError` or `MissingExtraError`.
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    options = options or SourceOptions()
    found = _opened(paths, options)
    if options.mask is None:
        return found
    return replace(found, camera=masked(found.camera, options.mask))


def _opened(paths: list[Path], options: SourceOptions) -> Recording:
    path = paths[0]
    for each in paths:
        if not each.exists():
            raise MissingFileError(f"source does not exist: {each}")
    if len(paths) > 1:
        return open_photos(paths, options)
    kind = source_kind(path)
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
    packet_bytes = 188  # of an MPEG transport stream
    with path.open("rb") as stream:
        head = stream.read(packet_bytes + 1)
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free"):  # ISO base media, QuickTime
        return True
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return True
    if len(head) > packet_bytes and head[0] == head[packet_bytes] == 0x47:
        return True
    return head.startswith((b"\x1aE\xdf\xa3", b"\0\0\1\xba", b"\0\0\1\xb3", b"FLV\1"))


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
) -> Iterator[RecordedView]:
    for view in folder.views:
        known = truth.get(view.frame)
        telemetry = with_options(view.telemetry, known, options)
        yield replace(view, telemetry=telemetry, truth_latlon_deg=known)


@dataclass(frozen=True)
class Imported:
    views: int  # all of them
    with_truth: int  # those with a true position
    complete: int  # those with all telemetry that a fix needs
    broken: int  # views left out because their image cannot be decoded, or has another size
    first_broken: str  # the error of the first one of them
    radians: bool  # whether the headings look like radians
    tilt_std_deg: tuple[float, float] | None
    """Least and largest stated standard deviation of pitch and roll; None: never stated."""


def import_flight(
    recording: Recording,
    out: Path,
    progress: Callable[[float], None] = lambda share: None,
) -> Imported:
    """Write the views of `recording` as a flight folder `out`, whole or not at all.

    Encoded images are copied unchanged; others are written as grey PNG. Views whose image cannot be
    decoded, or has another size than the camera, are left out and counted. Raises `FlightError`
    where none is left, `OutputError` where `out` cannot be written.
    """
    views = truths = complete = broken = 0
    first_broken, yaw_deg, tilt_std_deg = "", [], []
    with replacing_folder(Path(out)) as folder:
        writer = FlightWriter(folder, recording.camera, recording.note, recording.choices)
        for view in recording.views:
            try:
                frame, data = _encoded_image(view, recording)
            except FlightError as error:
                broken, first_broken = broken + 1, first_broken or str(error)
                continue
            writer.add_encoded(frame, data, view.telemetry, view.truth_latlon_deg)
            views += 1
            yaw_deg.append(view.telemetry.yaw_deg)
            if view.telemetry.tilt_std_deg is not None:
                tilt_std_deg.append(view.telemetry.tilt_std_deg)
            truths += view.truth_latlon_deg is not None
            complete += not view.telemetry.missing()
            if recording.expected:
                progress(min(1.0, (views + broken) / recording.expected))
        if views == 0:
            raise FlightError(first_broken or f"recording has no view: {recording.path}")
        writer.close()
    tilt = (min(tilt_std_deg), max(tilt_std_deg)) if tilt_std_deg else None
    return Imported(views, truths, complete, broken, first_broken, seem_radians(yaw_deg), tilt)


def _encoded_image(view: RecordedView, recording: Recording) -> tuple[str, bytes]:
    grey, camera = view.grey(), recording.camera
    if grey.shape != (camera.height_px, camera.width_px):
        raise FlightError(
            f"camera is {camera.width_px} x {camera.height_px} px, the image is "
            f"{grey.shape[1]} x {grey.shape[0]} px: {view.where}"
        )
    if view.data is not None and view.frame.lower().endswith(SUFFIXES):
        return view.frame, view.data()
    frame = str(PurePosixPath(view.frame).with_suffix(".png"))
    return frame, encoded(grey, frame)
