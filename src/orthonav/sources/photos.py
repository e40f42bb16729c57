"""A folder of photographs, with their own metadata or a log joined by time."""

import logging
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from orthonav.errors import CameraError, FlightError, lfs_pointer
from orthonav.flight import read_image
from orthonav.geo.camera import Camera
from orthonav.records import Telemetry
from orthonav.sources.cameras import read_camera_file
from orthonav.sources.exif import Photo, read_photo
from orthonav.sources.focal import FocalLength, focal_length
from orthonav.sources.logs import read_log
from orthonav.sources.options import SourceOptions
from orthonav.sources.photo_poses import PhotoPose, poses_of
from orthonav.sources.recording import (
    Recording,
    SourceView,
    check_overlap,
    fitted,
    height_warnings,
    jump_warnings,
    known_at,
    rounded,
    time_warnings,
    warnings_of,
    with_mean_velocities,
    with_options,
)
from orthonav.sources.track import RecordedTrack

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_BY_NAME_NS = 10**9
"""Spacing of photographs without a time, which are ordered by name."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _DatedPhoto:
    """A photograph, its time by the log's clock, and its attitude."""

    path: Path
    time_ns: int
    photo: Photo
    pose: PhotoPose | None = None
    """None where a log has it."""


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

    Raises `FlightError`, `CameraError` or `MissingExtraError`. Photographs that cannot be read,
    have no time, or another size or focal length than most, are left out, with a warning.
    """
    taken, warnings = _taken(folder, options)
    if options.camera is None:
        taken, zoomed = _of_one_focal_length(taken, options)
        warnings += zoomed
    camera, note = _camera(taken[0], options)
    track = None
    if options.telemetry is not None:
        track = read_log(options.telemetry, options.mount_deg)
        check_overlap(track, taken[0].time_ns, taken[-1].time_ns, options.telemetry)
        warnings += warnings_of(track, options)
    else:
        poses, doubts = poses_of([one.photo for one in taken])
        taken = [replace(one, pose=pose) for one, pose in zip(taken, poses, strict=True)]
        warnings += doubts
        warnings += _height_warnings([one.photo for one in taken], options)
        warnings += jump_warnings([(one.time_ns, one.photo.latlon_deg) for one in taken])
    warnings += _doubts(taken)
    warnings += time_warnings(one.time_ns for one in taken)
    views = partial(_views, folder, taken, track, options)
    return Recording(
        kind="photos",
        path=folder,
        camera=camera,
        note="; ".join(filter(None, [f"photographs of {folder.name}", note])),
        expected=len(taken),
        stream=views if track is None else lambda: with_mean_velocities(views(), track),
        warnings=tuple(filter(None, [*warnings, note])),
        take_off_latlon_deg=None if track is None else track.take_off_latlon_deg,
    )


def _doubts(taken: Sequence[_DatedPhoto]) -> list[str]:
    """Warnings about values that cannot be used, with the number of photographs and an example."""
    doubted = [one for one in taken if one.photo.doubts]
    if not doubted:
        return []
    first = doubted[0]
    return [
        f"values of {len(doubted)} of {len(taken)} photographs cannot be used, such as "
        f"{first.photo.doubts[0]}: {first.path.name}"
    ]


def _height_warnings(photos: Sequence[Photo], options: SourceOptions) -> list[str]:
    """Assumptions about the heights of photographs without a log."""
    above_home = any(math.isfinite(photo.home_m) for photo in photos)
    usable = above_home or any(
        math.isfinite(value) for photo in photos for value in (photo.amsl_m, photo.hae_m)
    )
    if options.over_terrain and usable:
        return []
    only_altitudes = not above_home and any(math.isfinite(photo.alt_m) for photo in photos)
    return height_warnings(above_home, only_altitudes, options)


def _taken(folder: Path, options: SourceOptions) -> tuple[list[_DatedPhoto], list[str]]:
    """The photographs that can be used, by time, and warnings."""
    paths = photo_paths(folder)
    if not paths:
        raise FlightError(f"folder has no photographs ({', '.join(SUFFIXES)}): {folder}")
    found: list[tuple[Path, Photo]] = []
    unread: list[Path] = []
    pointer = None
    for path in paths:
        try:
            found.append((path, read_photo(path)))
        except FlightError as error:
            log.info("%s", error)
            unread.append(path)
            pointer = pointer or _pointer(path)
    found, odd = _of_one_size(found)
    timed = [one for one in found if one[1].time_ns is not None]
    untimed = [path for path, photo in found if photo.time_ns is None]
    by_name = _by_name(found) if options.telemetry is None else []
    if len(by_name) > len(timed):
        timed, untimed = by_name, [one for one in untimed if one not in dict(by_name)]
    warnings = [
        f"{len(bad)} of {len(paths)} photographs left out, {why}, the first: {bad[0].name}"
        for bad, why in (
            (unread, pointer or "not readable"),
            (odd, "of another size than most"),
            (untimed, "no time in EXIF"),
        )
        if bad
    ]
    if not timed:
        raise FlightError(f"{'; '.join(warnings)}: {folder}")
    if timed is by_name:
        warnings.append(
            f"no time in EXIF of {len(timed)} photographs: ordered by name, one second apart"
        )
    elif guessed := sum(not photo.zone_known for _, photo in timed):
        warnings.append(f"no time zone in EXIF of {guessed} photographs: UTC assumed")
    taken = [
        _DatedPhoto(path, (photo.time_ns or 0) + options.time_offset_ns, photo)
        for path, photo in timed
    ]
    return sorted(taken, key=lambda one: (one.time_ns, one.path)), warnings


def _pointer(path: Path) -> str | None:
    """What to do about a file that is a pointer of Git LFS."""
    with path.open("rb") as stream:
        return lfs_pointer(stream.read(64))


def _of_one_size(
    found: Sequence[tuple[Path, Photo]],
) -> tuple[list[tuple[Path, Photo]], list[Path]]:
    """The photographs of the most frequent size, of two the larger one, and the other files."""
    sizes = Counter((photo.width_px, photo.height_px) for _, photo in found)
    usual = max(sizes, key=lambda size: (sizes[size], size[0] * size[1]), default=None)
    alike = [one for one in found if (one[1].width_px, one[1].height_px) == usual]
    odd = [path for path, photo in found if (photo.width_px, photo.height_px) != usual]
    return alike, odd


def _of_one_focal_length(
    taken: list[_DatedPhoto], options: SourceOptions
) -> tuple[list[_DatedPhoto], list[str]]:
    """The photographs of the most frequent focal length, and a warning about others.

    Those that state none are used too, and all of them where no focal length can be used.
    """
    found: list[FocalLength | CameraError | None] = []
    for one in taken:
        photo = one.photo
        try:
            found.append(
                focal_length(photo.optics, photo.width_px, photo.height_px, options.sensor_width_mm)
            )
        except CameraError as error:
            found.append(error)
    known = Counter(each for each in found if isinstance(each, FocalLength))
    if not known:
        return taken, []
    usual = known.most_common(1)[0][0]
    alike: list[_DatedPhoto] = []
    odd: list[_DatedPhoto] = []
    for one, each in zip(taken, found, strict=True):
        other = isinstance(each, CameraError) or (
            each is not None and abs(each.px / usual.px - 1) > usual.std
        )
        (odd if other else alike).append(one)
    if not odd:
        return taken, []
    return alike, [
        f"{len(odd)} of {len(taken)} photographs left out, of another focal length than most, "
        f"the first: {odd[0].path.name}"
    ]


def _by_name(found: Sequence[tuple[Path, Photo]]) -> list[tuple[Path, Photo]]:
    """Photographs with a pose but without a time, in the order of their names."""
    posed = [
        (path, photo)
        for path, photo in found
        if photo.time_ns is None
        and not (photo.gimbal_deg is None and photo.rotation is None and photo.latlon_deg is None)
    ]
    posed.sort(key=lambda one: _natural(one[0]))
    return [
        (path, replace(photo, time_ns=number * _BY_NAME_NS))
        for number, (path, photo) in enumerate(posed)
    ]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key that puts IMG_9 before IMG_10."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _camera(first: _DatedPhoto, options: SourceOptions) -> tuple[Camera, str]:
    width, height = first.photo.width_px, first.photo.height_px
    if options.camera is not None:
        return fitted(read_camera_file(options.camera), width, height, str(first.path)), ""
    try:
        focal = focal_length(first.photo.optics, width, height, options.sensor_width_mm)
    except CameraError as error:
        raise CameraError(f"{error}: {first.path}") from error
    if focal is None:
        raise CameraError(f"photograph has no focal length; give --camera FILE: {first.path}")
    camera = Camera(width, height, focal.px, focal.px, width / 2, height / 2, focal_std=focal.std)
    return (
        camera,
        f"focal length {focal.px:.0f} px, good to {100 * focal.std:.0f} %: {focal.source}",
    )


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
    photo, pose = one.photo, one.pose or PhotoPose()
    height = photo.home_m
    if math.isnan(height) and options.ground_alt_m is not None:
        height = photo.alt_m - options.ground_alt_m
    return Telemetry(
        one.time_ns,
        pose.yaw_deg,
        pose.pitch_deg,
        pose.roll_deg,
        height,
        yaw_std_deg=pose.yaw_std_deg,
        tilt_std_deg=pose.tilt_std_deg,
        vel_en_mps=photo.vel_en_mps,
        home_m=_known(photo.home_m),
        amsl_m=_known(photo.amsl_m),
        hae_m=_known(photo.hae_m),
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
