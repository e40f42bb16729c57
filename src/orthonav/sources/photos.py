"""A folder of photographs, with their own metadata or a log joined by time."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from orthonav.errors import CameraError, FlightError
from orthonav.flight import read_image
from orthonav.geo.camera import Camera, attitude_of
from orthonav.records import Telemetry
from orthonav.sources.cameras import read_camera_file
from orthonav.sources.exif import Photo, read_photo
from orthonav.sources.logs import read_log
from orthonav.sources.options import SourceOptions
from orthonav.sources.recording import (
    Recording,
    SourceView,
    check_overlap,
    fitted,
    known_at,
    rounded,
    with_options,
)
from orthonav.sources.track import RecordedTrack

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
EXIF_NOTE = "focal length from EXIF: expect errors of some per cent"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _DatedPhoto:
    """A photograph and its time by the log's clock."""

    path: Path
    time_ns: int
    photo: Photo


def photo_paths(folder: Path) -> list[Path]:
    """Photographs below a folder, hidden ones left out, by name."""
    found = folder.rglob("*")
    return sorted(
        path
        for path in found
        if path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def open_photos(folder: Path, options: SourceOptions) -> Recording:
    """The flight of a folder of photographs, by time.

    Raises `FlightError`, `CameraError` or `MissingExtraError`. Photographs that cannot be read or
    have no time are left out, with a warning.
    """
    taken, warnings = _taken(folder, options)
    camera, note = _camera(taken[0], options)
    track = None
    if options.telemetry is not None:
        track = read_log(options.telemetry, options.mount_deg)
        check_overlap(track, taken[0].time_ns, taken[-1].time_ns, options.telemetry)
    return Recording(
        kind="photos",
        path=folder,
        camera=camera,
        note="; ".join(filter(None, [f"photographs of {folder.name}", note])),
        expected=len(taken),
        stream=partial(_views, folder, taken, track, options),
        warnings=tuple(filter(None, [*warnings, note])),
    )


def _taken(folder: Path, options: SourceOptions) -> tuple[list[_DatedPhoto], list[str]]:
    """The photographs that can be read and have a time, by time, and warnings."""
    paths = photo_paths(folder)
    if not paths:
        raise FlightError(f"folder has no photographs ({', '.join(SUFFIXES)}): {folder}")
    taken, unread, untimed, guessed = [], [], [], 0
    for path in paths:
        try:
            photo = read_photo(path, options.sensor_width_mm)
        except FlightError as error:
            log.info("%s", error)
            unread.append(path)
            continue
        if photo.time_ns is None:
            untimed.append(path)
        else:
            guessed += not photo.zone_known
            taken.append(_DatedPhoto(path, photo.time_ns + options.time_offset_ns, photo))
    warnings = [
        f"{len(bad)} of {len(paths)} photographs left out, {why}, the first: {bad[0].name}"
        for bad, why in ((unread, "not readable"), (untimed, "no time in EXIF"))
        if bad
    ]
    if not taken:
        raise FlightError(f"{'; '.join(warnings)}: {folder}")
    if guessed:
        warnings.append(f"no time zone in EXIF of {guessed} photographs: UTC assumed")
    return sorted(taken, key=lambda one: (one.time_ns, one.path)), warnings


def _camera(first: _DatedPhoto, options: SourceOptions) -> tuple[Camera, str]:
    width, height = first.photo.width_px, first.photo.height_px
    if options.camera is not None:
        return fitted(read_camera_file(options.camera), width, height, str(first.path)), ""
    focal = first.photo.focal_px
    if focal is None or not math.isfinite(focal):
        raise CameraError(f"photograph has no focal length; give --camera FILE: {first.path}")
    return Camera(width, height, focal, focal, width / 2, height / 2), EXIF_NOTE


def _views(
    folder: Path, taken: list[_DatedPhoto], track: RecordedTrack | None, options: SourceOptions
) -> Iterator[SourceView]:
    for one in taken:
        if track is None:
            truth = one.photo.latlon_deg
            telemetry = rounded(with_options(_own_telemetry(one, options), truth, options))
        else:
            telemetry, truth = known_at(track, one.time_ns, options)
        yield SourceView(
            frame=one.path.relative_to(folder).as_posix(),
            telemetry=telemetry,
            truth_latlon_deg=truth or one.photo.latlon_deg,
            where=str(one.path),
            load=partial(read_image, one.path),
            data=one.path.read_bytes,
        )


def _own_telemetry(one: _DatedPhoto, options: SourceOptions) -> Telemetry:
    """Telemetry from the metadata of the photograph itself."""
    photo = one.photo
    yaw = pitch = roll = math.nan
    if photo.rotation is not None:
        yaw, pitch, roll = attitude_of(photo.rotation)
    height = photo.height_m
    if math.isnan(height) and options.ground_alt_m is not None:
        height = photo.alt_m - options.ground_alt_m
    return Telemetry(one.time_ns, yaw, pitch, roll, height, vel_en_mps=photo.vel_en_mps)
