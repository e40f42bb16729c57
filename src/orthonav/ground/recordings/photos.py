"""A folder of photographs, with their own metadata or a log joined by time."""

import logging
import math
import os
import re
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from orthonav.core.errors import CameraError, FlightError, lfs_pointer
from orthonav.core.files import require_file
from orthonav.core.flight import read_image
from orthonav.core.flight.recording import RecordedView
from orthonav.core.geo.attitude import enu_from_gimbal_camera
from orthonav.core.geo.camera import Camera, attitude_of
from orthonav.core.records import Telemetry
from orthonav.core.tilt import ASSUMED, AUTOPILOT, GIMBAL, TiltSource
from orthonav.ground.recordings.exif import FocalLength, Photo, focal_length, read_photo
from orthonav.ground.recordings.image_table import (
    ImageTable,
    is_image_table,
    names_images,
    read_image_table,
)
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    check_overlap,
    given_camera,
    height_warnings,
    known_at,
    rounded,
    time_warnings,
    warnings_of,
    with_mean_velocities,
    with_options,
)
from orthonav.ground.recordings.telemetry_track import RecordedTrack

log = logging.getLogger(__name__)

ZONE_STEP_NS, MAX_LAG_NS = 900 * 10**9, 20 * 10**9
"""Zones are quarters of an hour; a clock that is off by more than the latter is corrected."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_EDITOR = re.compile(
    r"microsoft|windows|photo\s*(?:viewer|shop|gallery|scape)|lightroom|gimp|picasa|paint|irfan"
    r"|acdsee|xnview|magick|digikam|darktable|rawtherapee|affinity|capture one|snapseed|preview"
    r"|pixelmator|faststone|zoner|corel|gthumb|shotwell|polarr|gwenview|nomacs|apple|google",
    re.IGNORECASE,
)
"""Programs that show, turn or develop photographs."""
ROUNDED = 0.02  # focal lengths of EXIF that differ by less, as a fraction, are of one lens


def photo_paths(folder: Path) -> list[Path]:
    found = folder.rglob("*")
    return sorted(
        path
        for path in found
        if path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def is_photo(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(8)
    return head.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*"))


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


def chosen_photos(sources: Sequence[Path], options: SourceOptions) -> ChosenPhotos:
    first, telemetry, table = sources[0], options.telemetry, None
    if telemetry is not None and is_image_table(require_file(telemetry, "telemetry log")):
        table = read_image_table(telemetry)
    if len(sources) == 1 and (first.is_dir() or is_image_table(first)):
        folder = first if first.is_dir() else first.parent
        paths = photo_paths(folder)
        if folder != first:
            table = read_image_table(first)
        elif telemetry is None:
            table = image_table_in(first, paths)
        return ChosenPhotos(folder, paths, table, table is not None)
    for path in sources:
        if not is_photo(require_file(path, "photograph")):
            raise FlightError(f"expected photographs, where several files are given: {path}")
    folder = Path(os.path.commonpath([path.resolve().parent for path in sources]))
    return ChosenPhotos(folder, [path.resolve() for path in sources], table, singly=True)


def image_table_in(folder: Path, photos: Sequence[Path]) -> ImageTable | None:
    """The table that lies in a folder and names some of these photographs below it."""
    names = [path.relative_to(folder).as_posix() for path in photos]
    file_names, found = {path.name.lower() for path in photos}, []
    for path in sorted(folder.iterdir()):
        if is_image_table(path):
            table = read_image_table(path)
            if any(table.row(name) for name in names):
                found.append(table)
            else:
                log.warning("table that names none of the photographs is not used: %s", path)
        elif names_images(path, file_names):
            log.warning("not read, for want of a header such as file,yaw,pitch,roll,agl: %s", path)
    if len(found) > 1:
        several = ", ".join(table.path.name for table in found[:5])
        raise FlightError(
            f"folder has several tables of images ({several}); give one by --telemetry: {folder}"
        )
    return found[0] if found else None


def posed(photos: Sequence[Photo], edited: Sequence[int]) -> tuple[list[Photo], list[str]]:
    """The photographs of a flight with their attitude, and warnings for people.

    Photographs of one camera are judged together: a gimbal that is level and points north in all of
    them, whatever the heading of the aircraft, was not recorded. The camera then looks straight
    down, with the heading of the aircraft. Where a table states the attitude, that one counts.
    `edited`: numbers of those that an editor has written.
    """
    turned = [photo for photo in photos if photo.gimbal_deg is None or any(photo.gimbal_deg)]
    recorded = {photo.optics.model for photo in turned}
    lost = [photo.optics.model not in recorded for photo in photos]
    # A heading of the aircraft that is 0 in all of them was not recorded either.
    yaws = [photo.body_yaw_deg for photo, gone in zip(photos, lost, strict=True) if gone]
    turns = any(math.isfinite(yaw) and yaw != 0 for yaw in yaws)
    poses = [_pose(photo, gone, turns) for photo, gone in zip(photos, lost, strict=True)]
    warnings = []
    if any(lost):
        warnings.append(
            f"gimbal angles of {sum(lost)} photographs are all 0, so they were not recorded: "
            "heading of the aircraft and a camera that looks straight down assumed"
        )
    if edited:
        warnings.append(
            f"{len(edited)} of {len(photos)} photographs were written by an editor "
            f"({photos[edited[0]].software}); one that was turned there has kept its angles, so "
            "the heading of these is taken as unknown"
        )
    for number in edited:
        poses[number]["yaw_std_deg"] = 180.0
    return [
        replace(photo, pose={**pose, **photo.pose})
        for photo, pose in zip(photos, poses, strict=True)
    ], warnings


def _edited(photos: Sequence[Photo]) -> list[int]:
    """Numbers of the photographs that an editor has written, which may have turned them."""
    usual, count = Counter(photo.software for photo in photos).most_common(1)[0]
    firmware = re.compile(r"[vV]?\d+(?:\.\d+)+")
    named = firmware.match(usual) is not None and 2 * count > len(photos)
    return [
        number
        for number, photo in enumerate(photos)
        if _EDITOR.search(photo.software)
        or (named and photo.software and not firmware.match(photo.software))
    ]


def _pose(photo: Photo, gimbal_unrecorded: bool, turns: bool) -> dict[str, Any]:
    source: TiltSource | None = None
    if gimbal_unrecorded:
        angles, source = (photo.body_yaw_deg % 360 if turns else math.nan, 0.0, 0.0), ASSUMED
    elif photo.gimbal_deg is not None:
        angles, source = attitude_of(enu_from_gimbal_camera(photo.gimbal_deg)), GIMBAL
    elif photo.rotation is not None:
        angles, source = attitude_of(photo.rotation), AUTOPILOT
    else:
        angles = photo.body_yaw_deg % 360, math.nan, math.nan
    pose: dict[str, Any] = dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles, strict=True))
    return pose if source is None else pose | source.stated(aided=photo.latlon_deg is not None)


def open_photos(sources: Sequence[Path], options: SourceOptions) -> Recording:
    """The flight of photographs, by time: of a folder, of a table of images, or named one by one.

    Photographs that cannot be read, have no time, or another size or focal length than most, are
    left out, with a warning.
    """
    chosen = chosen_photos(sources, options)
    if chosen.table is not None:
        options = replace(options, telemetry=None)
    photos, warnings = _taken(chosen, options)
    focal_px = [_focal_px(photo, options) for photo in photos]
    photos, zoomed = _alike(photos, focal_px, "of another focal length than most", ROUNDED)
    warnings += zoomed
    edited = _edited(photos)
    camera, note = _camera(photos, edited, options)
    track = None
    if options.telemetry is not None:
        track = read_log(options.telemetry, options.mount_deg, options.topics)
        check_overlap(track, _time_ns(photos[0]), _time_ns(photos[-1]), options.telemetry)
        warnings += warnings_of(track, options)
    else:
        photos, doubts = posed(photos, edited)
        warnings += doubts
        level = sum(math.isnan(photo.pose["pitch_deg"]) for photo in photos)
        if chosen.singly and level:
            options = replace(options, looks_down=True)
            warnings.append(
                f"pitch and roll of {level} of {len(photos)} photographs are not known: a camera "
                "that looks straight down is assumed"
            )
        names = ("home_m", "amsl_m", "hae_m", "alt_m")
        heights = {each for each in names if not all(math.isnan(getattr(p, each)) for p in photos)}
        if any(math.isnan(photo.agl_m) for photo in photos):
            warnings += height_warnings(options, heights)
    if turned := [photo.path.name for photo in photos if photo.turned]:
        warnings.append(
            f"other programs show {len(turned)} of {len(photos)} photographs turned (orientation "
            f"of EXIF); here pixels and the top are as stored, the first: {turned[0]}"
        )
    doubted = [photo for photo in photos if photo.doubts]
    if doubted:
        warnings.append(
            f"values of {len(doubted)} of {len(photos)} photographs cannot be used, such as "
            f"{doubted[0].doubts[0]}: {doubted[0].path.name}"
        )
    warnings += time_warnings(map(_time_ns, photos))
    folder = chosen.folder
    table = None if chosen.table is None else f"table {chosen.table.path.name}"
    views = partial(_views, folder, photos, track, options)
    return Recording(
        kind="photos",
        path=folder if len(sources) > 1 else sources[0],
        camera=camera,
        note="; ".join(filter(None, [f"photographs of {folder.name}", table, note])),
        expected=len(photos),
        stream=views if track is None else lambda: with_mean_velocities(views(), track),
        warnings=tuple(filter(None, [*warnings, "" if options.fov_deg else note])),
        choices=() if track is None else track.choices,
        take_off_latlon_deg=None if track is None else track.take_off_latlon_deg,
    )


def _time_ns(photo: Photo) -> int:
    return photo.time_ns or 0


def _taken(chosen: ChosenPhotos, options: SourceOptions) -> tuple[list[Photo], list[str]]:
    folder, paths = chosen.folder, chosen.paths
    if not paths:
        raise FlightError(f"folder has no photographs ({', '.join(SUFFIXES)}): {folder}")
    photos: list[Photo] = []
    unread: list[Path] = []
    reason = ""
    for path in paths:
        try:
            photos.append(read_photo(path))
        except FlightError as error:
            log.info("%s", error)
            unread.append(path)
            with path.open("rb") as stream:
                reason = reason or lfs_pointer(stream.read(64)) or ""
    warnings = _left_out(paths, unread, reason or "not readable")
    sizes = [(photo.width_px, photo.height_px) for photo in photos]
    photos, odd = _alike(photos, sizes, "of another size than most")
    warnings += odd
    if photos:
        photos, wrong = _by_gps(photos)
        photos, lost = _with_rows(photos, chosen)
        photos, untimed, undated = _in_time(photos, chosen, options)
        warnings += wrong + lost + _left_out(paths, untimed, "no time in EXIF")
    if not photos:
        raise FlightError(f"{'; '.join(warnings)}: {folder}")
    if undated and len(photos) > 1:
        warnings.append(
            f"no time in EXIF of {undated} photographs: ordered by name, one second apart"
        )
    elif not undated and (guessed := sum(not photo.zone_known for photo in photos)):
        warnings.append(f"no time zone in EXIF of {guessed} photographs: UTC assumed")
    photos = [replace(each, time_ns=_time_ns(each) + options.time_offset_ns) for each in photos]
    return sorted(photos, key=lambda photo: (_time_ns(photo), photo.path)), warnings


def _left_out(all_of_them: Sequence[Path | Photo], bad: Sequence[Path], reason: str) -> list[str]:
    if not bad:
        return []
    count = f"{len(bad)} of {len(all_of_them)} photographs left out"
    return [f"{count}, {reason}, the first: {bad[0].name}"]


def _alike(
    photos: list[Photo], keys: Sequence[Any], reason: str, tolerance: float = 0.0
) -> tuple[list[Photo], list[str]]:
    """The photographs with the most frequent key or without one, and a warning about others, which
    include those with NaN. All of them where none has a key. `tolerance`: as a fraction."""
    counted = Counter(key for key in keys if key is not None and key == key)
    if not counted:
        return photos, []
    if tolerance:  # those that are as near count as one
        near = {key: [k for k in counted if np.isclose(k, key, rtol=tolerance)] for key in counted}
        counted = Counter({key: sum(counted[k] for k in near[key]) for key in counted})
    usual = max(counted, key=lambda key: (counted[key], key))
    first = {key: photo.path.name for key, photo in zip(keys, photos, strict=True)}
    rivals = [key for key in counted if counted[key] == counted[usual] > 1]
    if len(rivals) > 1 and not np.allclose(rivals, usual, rtol=tolerance, atol=0.0):
        several = ", ".join(f"{counted[key]} as {first[key]}" for key in rivals)
        raise FlightError(f"photographs {reason}: {several}; give the files of one camera")
    fits = [key is None or np.allclose(key, usual, rtol=tolerance, atol=0.0) for key in keys]
    odd = [photo.path for photo, fit in zip(photos, fits, strict=True) if not fit]
    alike = [photo for photo, fit in zip(photos, fits, strict=True) if fit]
    return alike, _left_out(photos, odd, reason)


def _with_rows(photos: list[Photo], chosen: ChosenPhotos) -> tuple[list[Photo], list[str]]:
    table = chosen.table
    if table is None:
        return photos, []
    names = [photo.path.relative_to(chosen.folder).as_posix() for photo in photos]
    pairs = [(photo, table.row(name)) for photo, name in zip(photos, names, strict=True)]
    known = [replace(photo, **row) for photo, row in pairs if row]
    without = [photo.path for photo, row in pairs if row is None]
    if not known:
        raise FlightError(
            f"table names none of the {len(photos)} photographs, such as {without[0].name}; it "
            f"names {next(iter(table.rows))}: {table.path}"
        )
    if len({photo.order for photo in known}) < len(known):
        raise FlightError(
            "a row of the table names several photographs of one name; give their paths below "
            f"{chosen.folder}: {table.path}"
        )
    warnings = [*table.warnings, *_left_out(photos, without, "not in the table")]
    lost = len({row["order"] for row in table.rows.values()}) - len(known)
    if lost:
        warnings.append(f"{lost} rows of the table have no photograph: {table.path}")
    return known, warnings


def _by_gps(photos: list[Photo]) -> tuple[list[Photo], list[str]]:
    """The photographs in UTC by the times of the GPS, and a warning about a clock that is off;
    those with a time zone in EXIF and those without one are judged apart."""
    warnings, shifts_ns = [], {}
    for known in (True, False):
        alike = (each for each in photos if each.zone_known == known)
        lags = [each.time_ns - each.gps_ns for each in alike if each.time_ns and each.gps_ns]
        # A GPS without a fix repeats its last time: then nothing is known of a stated zone.
        if not lags or (known and max(lags) - min(lags) > MAX_LAG_NS):
            continue
        shifts_ns[known] = lag_ns = round(statistics.median(lags))
        steps = 0 if known else round(lag_ns / ZONE_STEP_NS)
        if abs(lag_ns - steps * ZONE_STEP_NS) <= MAX_LAG_NS and -48 <= steps <= 56:
            shifts_ns[known] = steps * ZONE_STEP_NS
        else:
            warnings.append(
                f"clock of the camera and time of its GPS differ by {lag_ns / 1e9:+.0f} s, which "
                "is no time zone: the time of the GPS is used"
            )
    return [
        replace(each, time_ns=each.time_ns - shifts_ns[each.zone_known], zone_known=True)
        if each.time_ns and each.zone_known in shifts_ns
        else each
        for each in photos
    ], warnings


def _in_time(
    photos: list[Photo], chosen: ChosenPhotos, options: SourceOptions
) -> tuple[list[Photo], list[Path], int]:
    """Photographs with a time, those without one that are left out, and the number of those that
    were given one by their order: where most have a pose but no time, and where they were named one
    by one and one of them has none."""
    untimed = [photo for photo in photos if photo.time_ns is None]
    if not untimed or options.telemetry is not None:
        ordered: list[Photo] = []
    elif chosen.singly:
        ordered = sorted(photos, key=lambda photo: photo.order)
    else:
        known = [
            one for one in untimed if one.gimbal_deg or one.rotation is not None or one.latlon_deg
        ]
        ordered = sorted(known, key=lambda photo: _natural(photo.path))
        ordered = ordered if len(ordered) > len(photos) - len(untimed) else []
    if not ordered:
        timed = [photo for photo in photos if photo.time_ns is not None]
        return timed, [photo.path for photo in untimed], 0
    left_out = [] if chosen.singly else [each.path for each in untimed if each not in ordered]
    spaced = [replace(each, time_ns=number * 10**9) for number, each in enumerate(ordered)]
    return spaced, left_out, len(spaced)


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", str(path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _focal_px(photo: Photo, options: SourceOptions) -> float | None:
    """The focal length, NaN for one that cannot be used, None for none."""
    try:
        found = focal_length(photo.optics, photo.width_px, photo.height_px, options.sensor_width_mm)
    except CameraError:
        return math.nan
    return None if found is None else found.px


def _camera(
    photos: Sequence[Photo], edited: Sequence[int], options: SourceOptions
) -> tuple[Camera, str]:
    photo = photos[0]
    width, height, path = photo.width_px, photo.height_px, photo.path
    given = given_camera(options, width, height, str(path))
    if given is not None:
        return given, "" if options.camera else f"field of view {options.fov_deg:g} deg, as given"
    try:
        focal = focal_length(photo.optics, width, height, options.sensor_width_mm)
    except CameraError as error:
        raise CameraError(f"{error}: {path}") from error
    if focal is None:
        raise CameraError(
            f"photograph has no focal length; give --camera FILE or --fov-deg: {path}"
        )
    if not edited and (lens := _factory_camera(photos, focal)):
        return lens, f"focal length {lens.fx_px:.0f} px and distortion: DewarpData of DJI"
    camera = Camera(width, height, focal.px, focal.px, width / 2, height / 2, focal_std=focal.std)
    share = f"good to {100 * focal.std:.0f} %"
    return camera, f"focal length {focal.px:.0f} px, {share}: {focal.source}"


def _factory_camera(photos: Sequence[Photo], focal: FocalLength) -> Camera | None:
    """The camera as DJI calibrated it, of photographs that no editor may have turned or dewarped;
    None where not all of them state the same one, and where it is of another size by EXIF."""
    lens, size = photos[0].lens, (photos[0].width_px, photos[0].height_px)
    if lens is None or any(each.lens != lens for each in photos):
        return None
    # A larger difference from the focal length of EXIF means another size of the picture.
    if size[0] < size[1] or abs(lens[0] / focal.px - 1) > 3.0 * focal.std:
        return None
    fx, fy, right, down, *distortion = lens
    middle = size[0] / 2 + right, size[1] / 2 + down
    try:
        # The focal length changes with focus.
        return Camera(*size, fx, fy, *middle, tuple(distortion), focal_std=0.01).plausible()
    except CameraError:
        return None


def _views(
    folder: Path, photos: list[Photo], track: RecordedTrack | None, options: SourceOptions
) -> Iterator[RecordedView]:
    for photo in photos:
        if track is None:
            truth = photo.latlon_deg
            telemetry = rounded(with_options(_own_telemetry(photo, options), truth, options))
        else:
            telemetry, truth = known_at(track, _time_ns(photo), options)
        yield RecordedView(
            frame=photo.path.relative_to(folder).as_posix(),
            telemetry=telemetry,
            truth_latlon_deg=truth or photo.latlon_deg,
            where=str(photo.path),
            load=partial(read_image, photo.path),
            data=photo.path.read_bytes,
        )


def _own_telemetry(photo: Photo, options: SourceOptions) -> Telemetry:
    height = photo.home_m if math.isnan(photo.agl_m) else photo.agl_m
    if math.isnan(height) and options.ground_alt_m is not None:
        height = photo.alt_m - options.ground_alt_m
    heights = {name: getattr(photo, name) for name in ("home_m", "amsl_m", "hae_m")}
    known = {name: value for name, value in heights.items() if math.isfinite(value)}
    return Telemetry(
        _time_ns(photo), agl_m=height, vel_en_mps=photo.vel_en_mps, **photo.pose, **known
    )
