"""A video, with subtitles, a table or a log joined by time.

It is decoded by OpenCV's FFmpeg, which is installed anyway; PyAV would add no format that is
needed here.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight.telemetry_track import RecordedTrack
from orthonav.ground.recordings.logs import end_ns, log_kind, read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    SourceView,
    check_overlap,
    given_camera,
    known_at,
    warnings_of,
    with_mean_velocities,
)

SIDECARS = (".srt", ".SRT", ".csv", ".CSV")
_SHORT_NS = 1_000_000_000
_MISSING_FRAMES = 0.01
SILENT = 0  # OpenCV's level of logging at which it writes nothing


def open_video(path: Path, options: SourceOptions) -> Recording:
    """The flight of a video, `options.rate_hz` views per second.

    Telemetry is that of `options.telemetry`, else of a file with the same name.
    """
    with _opened(path) as capture:
        sides = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = map(int, sides)
        fps, frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if width < 1 or height < 1 or not capture.grab():
            raise FlightError(f"video has no frame: {path}")
    camera = given_camera(options, width, height, str(path))
    if camera is None:
        raise CameraError(
            f"the camera of a video is unknown; give --camera FILE or --fov-deg: {path}"
        )
    last_ns = round((frames - 1) / fps * 1e9) if fps > 0 and frames > 0 else 0
    track, telemetry_path, warnings = _track(path, last_ns, options)
    return Recording(
        kind="video",
        path=path,
        camera=camera,
        note=f"video {path.name}, telemetry of {telemetry_path.name}",
        expected=math.floor(last_ns / 1e9 * options.rate_hz) + 1 if last_ns else 0,
        stream=lambda: with_mean_velocities(_views(path, track, options), track),
        warnings=(*warnings, *warnings_of(track, options)),
        choices=track.choices,
        take_off_latlon_deg=track.take_off_latlon_deg,
    )


def _track(
    path: Path, last_ns: int, options: SourceOptions
) -> tuple[RecordedTrack, Path, list[str]]:
    beside = [path.with_suffix(suffix) for suffix in SIDECARS]
    telemetry_path = options.telemetry or next((one for one in beside if one.is_file()), None)
    if telemetry_path is None:
        raise FlightError(
            f"no telemetry beside the video ({path.stem}.srt or .csv); give --telemetry: {path}"
        )
    track = read_log(telemetry_path, options.mount_deg, options.topics)
    start_ns = track.origin_ns + options.time_offset_ns
    check_overlap(track, start_ns, start_ns + last_ns, telemetry_path)
    warnings: list[str] = []
    short_ns = start_ns + last_ns - end_ns(track)
    if log_kind(telemetry_path) in ("srt", "table") and short_ns > _SHORT_NS:
        warnings.append(
            f"telemetry ends {short_ns / 1e9:.1f} s before the video of {last_ns / 1e9:.1f} s; "
            f"views after its end have none: {telemetry_path}"
        )
    return track, telemetry_path, warnings


def _views(path: Path, track: RecordedTrack, options: SourceOptions) -> Iterator[SourceView]:
    start_ns = track.origin_ns + options.time_offset_ns
    due, number, stuck, before_ns = 0, 0, 0, -1
    with _opened(path) as capture:
        promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        while capture.grab():
            time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            stuck += time_ns <= before_ns
            if time_ns > before_ns and time_ns >= due / options.rate_hz * 1e9 - 1:
                due = math.floor(time_ns / 1e9 * options.rate_hz + 1e-6) + 1
                telemetry, truth = known_at(track, start_ns + time_ns, options)
                where = f"frame {number} of {path}"
                found, frame = capture.retrieve()
                yield SourceView(
                    frame=f"{number:06d}.png",
                    telemetry=telemetry,
                    truth_latlon_deg=truth,
                    where=where,
                    load=partial(_grey, np.asarray(frame) if found else None, where),
                )
            number, before_ns = number + 1, max(time_ns, before_ns)
    if stuck > number / 2:
        raise FlightError(f"video has no times: {path}")
    if number < promised - max(2, _MISSING_FRAMES * promised):
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
    logging.setLogLevel(SILENT)
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
