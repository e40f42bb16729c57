"""Attitudes of the photographs of a flight: what their metadata mean when seen together."""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthonav.core.geo.attitude import (
    ASSUMED_TILT_STD_DEG,
    AUTOPILOT_TILT_STD_DEG,
    GIMBAL_TILT_STD_DEG,
    enu_from_gimbal_camera,
)
from orthonav.core.geo.camera import attitude_of
from orthonav.ground.recordings.exif import Photo

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
