"""A folder of photographs, with their own metadata or a log joined by time."""

import logging
import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from orthonav.core.errors import CameraError, FlightError, lfs_pointer
from orthonav.core.files import require_file
from orthonav.core.flight import read_image
from orthonav.core.flight.telemetry_track import RecordedTrack
from orthonav.core.geo.attitude import (
    ASSUMED_TILT_STD_DEG,
    AUTOPILOT_TILT_STD_DEG,
    GIMBAL_TILT_STD_DEG,
    enu_from_gimbal_camera,
)
from orthonav.core.geo.camera import Camera, attitude_of
from orthonav.core.records import Telemetry
from orthonav.ground.recordings.exif import Photo, read_photo
from orthonav.ground.recordings.focal import FocalLength, focal_length
from orthonav.ground.recordings.image_table import (
    ImageRow,
    ImageTable,
    is_image_table,
    read_image_table,
)
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    SourceView,
    check_overlap,
    given_camera,
    height_warnings,
    jump_warnings,
    known_at,
    rounded,
    time_warnings,
    warnings_of,
    with_mean_velocities,
    with_options,
)

log = logging.getLogger(__name__)

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_MAGICS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*")


def photo_paths(folder: Path) -> list[Path]:
    """Photographs below a folder, hidden ones left out, by name."""
    found = folder.rglob("*")
    return sorted(
        path
        for path in found
        if path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def is_photo(path: Path) -> bool:
    """Whether a file begins as an image does."""
    with path.open("rb") as stream:
        return stream.read(8).startswith(_MAGICS)


@dataclass(frozen=True)
class ChosenPhotos:
    """The images of a source: below `folder`, with the table that describes them, if any.

    `singly`: whether they were named one by one, by the user or by the table. Then they need no
    time, and a camera that looks straight down is assumed where nothing else is known.
    """

    folder: Path
    paths: Sequence[Path]
    table: ImageTable | None
    singly: bool

    @classmethod
    def of(cls, sources: Sequence[Path], options: SourceOptions) -> "ChosenPhotos":
        """The images of a folder, of a table in it, or those named."""
        first, telemetry = sources[0], options.telemetry
        table = None
        if telemetry is not None and is_image_table(require_file(telemetry, "telemetry log")):
            table = read_image_table(telemetry)
        if len(sources) == 1 and first.is_dir():
            paths = photo_paths(first)
            if table is None and telemetry is None:
                table = image_table_in(first, paths)
            return cls(first, paths, table, table is not None)
        if len(sources) == 1 and is_image_table(first):
            return cls(first.parent, photo_paths(first.parent), read_image_table(first), True)
        for path in sources:
            if not is_photo(require_file(path, "photograph")):
                raise FlightError(f"expected photographs, where several files are given: {path}")
        folder = Path(os.path.commonpath([path.resolve().parent for path in sources]))
        return cls(folder, [path.resolve() for path in sources], table, True)


def image_table_in(folder: Path, photos: Sequence[Path]) -> ImageTable | None:
    """The table that lies in a folder and names some of these photographs below it.

    Raises `FlightError` where there are several.
    """
    names = [path.relative_to(folder).as_posix() for path in photos]
    found = []
    for path in sorted(path for path in folder.iterdir() if is_image_table(path)):
        table = read_image_table(path)
        if any(table.row(name) for name in names):
            found.append(table)
        else:
            log.warning("table that names none of the photographs is not used: %s", path)
    if len(found) > 1:
        several = ", ".join(table.path.name for table in found[:5])
        raise FlightError(
            f"folder has several tables of images ({several}); give one by --telemetry: {folder}"
        )
    return found[0] if found else None


UNKNOWN_YAW_STD_DEG = 180.0
"""Standard deviation of a heading that may be off by any angle."""
_TURNED_DEG = 5.0
"""A gimbal follows the aircraft within a few degrees; at more it would not report 0."""
_OPPOSED_DEG = 135.0
_EDITOR = re.compile(
    r"microsoft|windows|photo\s*(?:viewer|shop|gallery|scape)|lightroom|gimp|picasa|paint|irfan"
    r"|acdsee|xnview|magick|digikam|darktable|rawtherapee|affinity|capture one|snapseed|preview"
    r"|pixelmator|faststone|zoner|corel|gthumb|shotwell|polarr|gwenview|nomacs|apple|google",
    re.IGNORECASE,
)
"""Programs that show, turn or develop photographs."""
_FIRMWARE = re.compile(r"[vV]?\d+(?:\.\d+)+")


@dataclass(frozen=True)
class PhotoPose:
    """Attitude of a photograph in the convention of orthonav; NaN where it is unknown."""

    yaw_deg: float = math.nan
    pitch_deg: float = math.nan
    roll_deg: float = math.nan
    yaw_std_deg: float | None = None
    """Standard deviation of the heading, None for the usual one."""
    tilt_std_deg: float | None = None
    """Standard deviation of pitch and roll by what recorded them, None where they are unknown."""


def poses_of(photos: Sequence[Photo]) -> tuple[list[PhotoPose], list[str]]:
    """The attitude of each photograph of a flight, and warnings for people.

    Photographs of one camera are judged together: a gimbal that is level and points north in all of
    them, whatever the heading of the aircraft, was not recorded. The camera then looks straight
    down, with the heading of the aircraft.
    """
    cameras: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for number, photo in enumerate(photos):
        cameras[photo.optics.make, photo.optics.model].append(number)
    unrecorded = {
        number
        for numbers in cameras.values()
        if _is_unrecorded([photos[each] for each in numbers])
        for number in numbers
    }
    poses = [
        _level(photo) if number in unrecorded else _pose(photo)
        for number, photo in enumerate(photos)
    ]
    warnings = []
    if unrecorded:
        warnings.append(
            f"gimbal angles of {len(unrecorded)} photographs are all 0, so they were not recorded: "
            "heading of the aircraft and a camera that looks straight down assumed"
        )
    edited = _edited(photos)
    if edited:
        warnings.append(_edited_warning(photos, poses, edited))
    for number in edited:
        poses[number] = replace(poses[number], yaw_std_deg=UNKNOWN_YAW_STD_DEG)
    return poses, warnings


def _level(photo: Photo) -> PhotoPose:
    """The attitude of a camera that is assumed to look straight down."""
    return PhotoPose(photo.body_yaw_deg % 360, 0.0, 0.0, tilt_std_deg=ASSUMED_TILT_STD_DEG)


def _pose(photo: Photo) -> PhotoPose:
    rotation, tilt_std_deg = photo.rotation, AUTOPILOT_TILT_STD_DEG
    if photo.gimbal_deg is not None:
        rotation, tilt_std_deg = enu_from_gimbal_camera(photo.gimbal_deg), GIMBAL_TILT_STD_DEG
    if rotation is None:
        return PhotoPose(photo.body_yaw_deg % 360)
    return PhotoPose(*attitude_of(rotation), tilt_std_deg=tilt_std_deg)


def _is_unrecorded(photos: Sequence[Photo]) -> bool:
    """Whether the gimbal reports 0, 0, 0 in all photographs while the aircraft is turned."""
    if any(photo.gimbal_deg is None or any(photo.gimbal_deg) for photo in photos):
        return False
    return any(abs(_signed(photo.body_yaw_deg)) > _TURNED_DEG for photo in photos)


def _edited(photos: Sequence[Photo]) -> list[int]:
    """Numbers of the photographs that an editor has written, which may have turned them."""
    usual, count = Counter(photo.software for photo in photos).most_common(1)[0]
    named = _FIRMWARE.match(usual) is not None and 2 * count > len(photos)
    return [
        number
        for number, photo in enumerate(photos)
        if _EDITOR.search(photo.software)
        or (named and photo.software and not _FIRMWARE.match(photo.software))
    ]


def _edited_warning(
    photos: Sequence[Photo], poses: Sequence[PhotoPose], edited: Sequence[int]
) -> str:
    text = (
        f"{len(edited)} of {len(photos)} photographs were written by an editor "
        f"({photos[edited[0]].software}); one that was turned there has kept its angles, "
        "so the heading of these is taken as unknown"
    )
    rest = [pose.yaw_deg for number, pose in enumerate(poses) if number not in set(edited)]
    mean = _mean_deg(rest)
    opposed = [abs(_signed(poses[each].yaw_deg - mean)) > _OPPOSED_DEG for each in edited]
    if all(opposed) and not math.isnan(mean):
        text += "; they were flown against the direction of the rest"
    return text


def _mean_deg(headings: Sequence[float]) -> float:
    """Mean direction; NaN where there is none."""
    known = np.radians([heading for heading in headings if math.isfinite(heading)])
    if not known.size:
        return math.nan
    return math.degrees(math.atan2(np.sin(known).sum(), np.cos(known).sum()))


def _signed(angle_deg: float) -> float:
    return (angle_deg + 180) % 360 - 180


_BY_NAME_NS = 10**9
"""Spacing of photographs without a time, which are ordered by name."""


@dataclass(frozen=True)
class _DatedPhoto:
    """A photograph, its time by the log's clock, and its attitude."""

    path: Path
    time_ns: int
    photo: Photo
    pose: PhotoPose | None = None
    """None where a log has it."""
    row: ImageRow | None = None
    """What a table says of it."""


def open_photos(sources: Sequence[Path], options: SourceOptions) -> Recording:
    """The flight of photographs, by time: of a folder, of a table of images, or named one by one.

    Raises `MissingFileError`, `FlightError`, `CameraError` or `MissingExtraError`. Photographs that
    cannot be read, have no time, or another size or focal length than most, are left out, with a
    warning.
    """
    chosen = ChosenPhotos.of(sources, options)
    if chosen.table is not None:
        options = replace(options, telemetry=None)
    folder, (taken, warnings) = chosen.folder, _taken(chosen, options)
    if options.camera is None and options.fov_deg is None:
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
        taken = [
            replace(one, pose=_pose_with_row(pose, one.row))
            for one, pose in zip(taken, poses, strict=True)
        ]
        warnings += doubts
        level = sum(math.isnan(one.pose.pitch_deg) for one in taken if one.pose)
        if chosen.singly and level:
            options = replace(options, looks_down=True)
            warnings.append(
                f"pitch and roll of {level} of {len(taken)} photographs are not known: a camera "
                "that looks straight down is assumed"
            )
        warnings += _height_warnings([one.photo for one in taken], options)
        warnings += jump_warnings([(one.time_ns, one.photo.latlon_deg) for one in taken])
    warnings += _doubts(taken)
    warnings += time_warnings(one.time_ns for one in taken)
    views = partial(_views, folder, taken, track, options)
    return Recording(
        kind="photos",
        path=folder if len(sources) > 1 else sources[0],
        camera=camera,
        note="; ".join(filter(None, [f"photographs of {folder.name}", *_table_note(chosen), note])),
        expected=len(taken),
        stream=views if track is None else lambda: with_mean_velocities(views(), track),
        warnings=tuple(filter(None, [*warnings, "" if options.fov_deg else note])),
        take_off_latlon_deg=None if track is None else track.take_off_latlon_deg,
    )


def _table_note(chosen: ChosenPhotos) -> list[str]:
    return [] if chosen.table is None else [f"table {chosen.table.path.name}"]


def _pose_with_row(pose: PhotoPose, row: ImageRow | None) -> PhotoPose:
    """The attitude of a photograph, where a table states it by the table."""
    if row is None:
        return pose
    if math.isfinite(row.pitch_deg):
        tilt = {"pitch_deg": row.pitch_deg, "roll_deg": row.roll_deg}
        pose = replace(pose, **tilt, tilt_std_deg=row.tilt_std_deg)
    if math.isfinite(row.yaw_deg):
        pose = replace(pose, yaw_deg=row.yaw_deg, yaw_std_deg=None)
    return pose


def _photo_with_row(photo: Photo, row: ImageRow) -> Photo:
    """The metadata of a photograph with the time, the position and the heights of a table."""
    if row.time_ns is not None:
        photo = replace(photo, time_ns=row.time_ns, zone_known=True)
    if row.has_height:
        heights = {name: getattr(row, name) for name in ("agl_m", "home_m", "amsl_m", "hae_m")}
        photo = replace(photo, **heights, alt_m=row.alt_m)
    return replace(photo, latlon_deg=row.latlon_deg or photo.latlon_deg)


def _with_rows(
    found: list[tuple[Path, Photo]], chosen: ChosenPhotos
) -> tuple[list[_DatedPhoto], list[str]]:
    """Photographs with their rows of the table, and warnings about those without one.

    Raises `FlightError` where no photograph has one.
    """
    if chosen.table is None:
        return [_DatedPhoto(path, photo.time_ns or 0, photo) for path, photo in found], []
    rows = [chosen.table.row(path.relative_to(chosen.folder).as_posix()) for path, _ in found]
    without = [path.name for (path, _), row in zip(found, rows, strict=True) if row is None]
    if len(without) == len(found):
        raise FlightError(
            f"table names none of the {len(found)} photographs, such as {without[0]}; it names "
            f"{next(iter(chosen.table.rows))}: {chosen.table.path}"
        )
    orders = [row.order for row in rows if row is not None]
    if len(set(orders)) < len(orders):
        raise FlightError(
            "a row of the table names several photographs of one name; give their paths below "
            f"{chosen.folder}: {chosen.table.path}"
        )
    warnings = list(chosen.table.warnings)
    if without:
        warnings.append(
            f"{len(without)} of {len(found)} photographs left out, not in the table, the first: "
            f"{without[0]}"
        )
    lost = len({row.order for row in chosen.table.rows.values()}) - len(found) + len(without)
    if lost:
        warnings.append(f"{lost} rows of the table have no photograph: {chosen.table.path}")
    return [
        _DatedPhoto(path, 0, _photo_with_row(photo, row), row=row)
        for (path, photo), row in zip(found, rows, strict=True)
        if row is not None
    ], warnings


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
    if all(math.isfinite(photo.agl_m) for photo in photos):
        return []
    above_home = any(math.isfinite(photo.home_m) for photo in photos)
    usable = above_home or any(
        math.isfinite(value) for photo in photos for value in (photo.amsl_m, photo.hae_m)
    )
    if options.over_terrain and usable:
        return []
    only_altitudes = not above_home and any(math.isfinite(photo.alt_m) for photo in photos)
    return height_warnings(above_home, only_altitudes, options)


def _taken(chosen: ChosenPhotos, options: SourceOptions) -> tuple[list[_DatedPhoto], list[str]]:
    """The photographs that can be used, by time, and warnings."""
    folder, paths = chosen.folder, chosen.paths
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
    warnings = _left_out(paths, [(unread, pointer or "not readable"), (odd, ODD_SIZE)])
    if not found:
        raise FlightError(f"{'; '.join(warnings)}: {folder}")
    dated, lost = _with_rows(found, chosen)
    timed, untimed, undated = _in_time(dated, chosen, options)
    warnings += lost + _left_out(paths, [([one.path for one in untimed], "no time in EXIF")])
    if not timed:
        raise FlightError(f"{'; '.join(warnings)}: {folder}")
    if undated and len(timed) > 1:
        warnings.append(
            f"no time in EXIF of {undated} photographs: ordered by name, one second apart"
        )
    elif not undated and (guessed := sum(not one.photo.zone_known for one in timed)):
        warnings.append(f"no time zone in EXIF of {guessed} photographs: UTC assumed")
    timed = [
        replace(one, time_ns=(one.photo.time_ns or 0) + options.time_offset_ns) for one in timed
    ]
    return sorted(timed, key=lambda one: (one.time_ns, one.path)), warnings


ODD_SIZE = "of another size than most"


def _left_out(paths: Sequence[Path], why: Sequence[tuple[Sequence[Path], str]]) -> list[str]:
    return [
        f"{len(bad)} of {len(paths)} photographs left out, {reason}, the first: {bad[0].name}"
        for bad, reason in why
        if bad
    ]


def _in_time(
    dated: list[_DatedPhoto], chosen: ChosenPhotos, options: SourceOptions
) -> tuple[list[_DatedPhoto], list[_DatedPhoto], int]:
    """Photographs with a time, those without one that are left out, and the number of those that
    were given one by their order: where most have a pose but no time, and where they were named one
    by one and one of them has none."""
    timed = [one for one in dated if one.photo.time_ns is not None]
    untimed = [one for one in dated if one.photo.time_ns is None]
    if not untimed or options.telemetry is not None:
        return timed, untimed, 0
    if chosen.singly:
        ordered = sorted(dated, key=lambda one: one.row.order if one.row else 0)
        return _one_second_apart(ordered), [], len(dated)
    posed = sorted(
        (one for one in untimed if _has_pose(one.photo)), key=lambda one: _natural(one.path)
    )
    if len(posed) <= len(timed):
        return timed, untimed, 0
    return _one_second_apart(posed), [one for one in untimed if one not in posed], len(posed)


def _has_pose(photo: Photo) -> bool:
    return not (photo.gimbal_deg is None and photo.rotation is None and photo.latlon_deg is None)


def _one_second_apart(ordered: Sequence[_DatedPhoto]) -> list[_DatedPhoto]:
    return [
        replace(one, photo=replace(one.photo, time_ns=number * _BY_NAME_NS))
        for number, one in enumerate(ordered)
    ]


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


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key that puts IMG_9 before IMG_10."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _camera(first: _DatedPhoto, options: SourceOptions) -> tuple[Camera, str]:
    width, height = first.photo.width_px, first.photo.height_px
    given = given_camera(options, width, height, str(first.path))
    if given is not None:
        return given, "" if options.camera else f"field of view {options.fov_deg:g} deg, as given"
    try:
        focal = focal_length(first.photo.optics, width, height, options.sensor_width_mm)
    except CameraError as error:
        raise CameraError(f"{error}: {first.path}") from error
    if focal is None:
        raise CameraError(
            f"photograph has no focal length; give --camera FILE or --fov-deg: {first.path}"
        )
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
    height = photo.home_m if math.isnan(photo.agl_m) else photo.agl_m
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
