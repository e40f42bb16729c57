"""A video, with subtitles, a table or a log joined by time.

It is decoded by OpenCV's FFmpeg, which is installed anyway; PyAV would add no format that is
needed here.
"""

import math
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight.recording import RecordedView, chosen
from orthonav.core.geo.camera import Camera
from orthonav.ground.recordings.logs import end_ns, log_kind, read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    check_overlap,
    given_camera,
    known_at,
    warnings_of,
    with_mean_velocities,
)
from orthonav.ground.recordings.telemetry_track import RecordedTrack

MAX_END_BYTES = 10_000_000


def open_video(path: Path, options: SourceOptions) -> Recording:
    """The flight of a video, `options.rate_hz` views per second; time 0 is the first frame shown.

    Telemetry is that of `options.telemetry`, else of a file with the same name.
    """
    with _opened(path) as capture:
        sides = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = map(int, sides)
        if width < 1 or height < 1 or not capture.grab():
            raise FlightError(f"video has no frame: {path}")
        camera = given_camera(options, width, height, str(path))
        if camera is None:
            raise CameraError(
                f"the camera of a video is unknown; give --camera FILE or --fov-deg: {path}"
            )
        _check_pixels(capture, camera, path)
        last_ns, promised, begin_s = _extent(path, capture)
        turn_deg = capture.get(cv2.CAP_PROP_ORIENTATION_META)
    track, telemetry_path, choices, warnings = _track(path, last_ns, options)
    said = f"players show the video turned by {turn_deg:g} deg; its frames are used as stored"
    warnings += [said] if turn_deg else []
    if begin_s > 1:
        warnings.append(
            f"the clock of the video begins at {begin_s:.1f} s; time 0 is its first frame. If "
            f"telemetry counts by that clock, add {begin_s:.1f} to --time-offset-s"
        )
    return Recording(
        kind="video",
        path=path,
        camera=camera,
        note=f"video {path.name}, telemetry of {telemetry_path.name}",
        expected=math.floor(last_ns / 1e9 * options.rate_hz) + 1 if last_ns else 0,
        stream=lambda: with_mean_velocities(_views(path, promised, track, options), track),
        warnings=(*warnings, *warnings_of(track, options)),
        choices=(*choices, *track.choices),
        take_off_latlon_deg=track.take_off_latlon_deg,
    )


def _check_pixels(capture: cv2.VideoCapture, camera: Camera, path: Path) -> None:
    """Raises `CameraError` where pixels are not square, and not of the shape of the camera's."""
    wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    stated = wide / high if wide > 0 and high > 0 else 1.0
    of_camera = camera.fy_px / camera.fx_px
    if min(abs(stated - 1), abs(of_camera / stated - 1)) > 0.02:
        raise CameraError(
            f"pixels of the video are {stated:.3f} times as wide as high, those of the camera "
            f"{of_camera:.3f}; give a --camera calibrated with its stored frames: {path}"
        )


def _extent(path: Path, capture: cv2.VideoCapture) -> tuple[int, int, float]:
    """When the last frame is shown, the least number of frames of a whole video (0 where either is
    not known), and where its clock begins; of a video whose first frame was grabbed."""
    fps, frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    if not (fps > 0 and frames > 0):
        return 0, 0, 0.0
    held, begin_s = _ends(path), capture.get(cv2.CAP_PROP_PTS) / fps
    streamed = held.startswith((b"\x47", b"\0\0\1\xba"))  # MPEG: clocks begin anywhere
    if streamed or not 0 < begin_s < 86_400.0:  # a later time is OpenCV's value for none
        begin_s = 0.0
    # Lengths of Matroska count from the time 0 of the clock.
    matroska, shown_s = held.startswith(b"\x1aE\xdf\xa3"), frames / fps
    if header := re.search(rb"(?s)moov.{4}mvhd(.{32})", held):  # ISO/IEC 14496-12, 8.2.2
        late = header[1][0] == 1
        scale, ticks = struct.unpack_from(">IQ" if late else ">II", header[1], 20 if late else 12)
        shown_s = ticks / (scale or 1) or shown_s
    shown = min(frames, (shown_s - begin_s) * fps) if matroska or header else frames
    least = shown if matroska or shown > frames - 1 else shown / 2  # hidden ones of another rate
    return round(max(0.0, shown - 1) / fps * 1e9), round(least), begin_s


def _ends(path: Path) -> bytes:
    """The begin and the end of a file: one of them has the index of an MP4 or MOV."""
    with path.open("rb") as stream:
        begin = stream.read(MAX_END_BYTES)
        stream.seek(max(len(begin), path.stat().st_size - MAX_END_BYTES))
        return begin + stream.read(MAX_END_BYTES)


def _track(
    path: Path, last_ns: int, options: SourceOptions
) -> tuple[RecordedTrack, Path, list[str], list[str]]:
    """Telemetry, its file, choices and warnings."""
    named = sorted(each for each in path.parent.iterdir() if each.stem == path.stem)
    beside = [
        each for suffix in (".srt", ".csv") for each in named if each.suffix.lower() == suffix
    ]
    telemetry_path = options.telemetry or next(iter(beside), None)
    if telemetry_path is None:
        raise FlightError(
            f"no telemetry beside the video ({path.stem}.srt or .csv), and none inside it is read; "
            f"give --telemetry: {path}"
        )
    why = "subtitles come before tables; --telemetry selects another file"
    unused = [] if options.telemetry else [each.name for each in beside[1:]]
    choices = [chosen("telemetry", telemetry_path.name, unused, why)] if unused else []
    track = read_log(telemetry_path, options.mount_deg, options.topics)
    start_ns = track.origin_ns + options.time_offset_ns
    check_overlap(track, start_ns, start_ns + last_ns, telemetry_path)
    warnings: list[str] = []
    short_ns = start_ns + last_ns - end_ns(track)
    if log_kind(telemetry_path) in ("srt", "table") and short_ns > 10**9:
        warnings.append(
            f"telemetry ends {short_ns / 1e9:.1f} s before the video of {last_ns / 1e9:.1f} s; "
            f"views after its end have none: {telemetry_path}"
        )
    return track, telemetry_path, choices, warnings


def _views(
    path: Path, promised: int, track: RecordedTrack, options: SourceOptions
) -> Iterator[RecordedView]:
    start_ns = track.origin_ns + options.time_offset_ns
    due, number, stuck, before_ns = 0, 0, 0, -1
    with _opened(path) as capture:
        while capture.grab():
            time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            stuck += time_ns <= before_ns
            if time_ns > before_ns and time_ns >= due / options.rate_hz * 1e9 - 1:
                due = math.floor(time_ns / 1e9 * options.rate_hz + 1e-6) + 1
                if track.zoomed is None or not track.zoomed.at(start_ns + time_ns)[0] > 0:
                    known = known_at(track, start_ns + time_ns, options)
                    where, (found, frame) = f"frame {number} of {path}", capture.retrieve()
                    load = partial(_grey, np.asarray(frame) if found else None, where)
                    yield RecordedView(f"{number:06d}.png", *known, where, load)
            number, before_ns = number + 1, max(time_ns, before_ns)
    if stuck > number / 2:
        raise FlightError(f"video has no times: {path}")
    if number < promised - max(2, promised / 100):
        raise FlightError(f"video was cut short: {number} of {promised} frames: {path}")


def _grey(frame: NDArray[Any] | None, where: str) -> NDArray[np.uint8]:
    if frame is None:
        raise FlightError(f"image of the flight cannot be decoded: {where}")
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    return np.asarray(grey, dtype=np.uint8)


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    """The open video; failures are reported as exceptions, so OpenCV's messages are dropped."""
    # OpenCV 5 has these in a module of their own, OpenCV 4 at the top.
    logging: Any = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(0)  # nothing
    try:
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    finally:
        logging.setLogLevel(before)
    try:
        if not capture.isOpened():
            raise FlightError(f"video cannot be opened: cut short, or not a video: {path}")
        # The camera describes the sensor: an orientation tag must not rotate the image.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()
