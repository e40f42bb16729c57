"""Images of live cameras (devices and streams) and of recordings played in real time.

A thread reads; the consumer gets the newest image, and replaced images are counted.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError, MissingFileError
from orthonav.core.files import require_file
from orthonav.core.flight import open_flight
from orthonav.core.records import NoFix, Telemetry, grey_levels
from orthonav.onboard.ports import retry_s
from orthonav.onboard.telemetry import Clocks, VehicleState

log = logging.getLogger(__name__)
STREAMS = ("rtsp://", "rtsps://", "http://", "https://", "udp://", "tcp://")
GAP_S = 3.0
"""A longer time without images, also in usual intervals, may change the latency. After a shorter
one, images can be late by as much: positions show it (`orthonav.onboard.latency`)."""
Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One image with its time of exposure."""

    number: int
    frame: str
    exposed_ns: int
    """By our monotonic clock; of a live camera the arrival, from which the flight loop subtracts
    the latency."""
    time_ns: int  # written to results: UTC of a live camera, else that of the recording
    grey: Grey | None  # (H, W), None where the image could not be decoded
    problem: NoFix | None = None
    telemetry: Telemetry | None = None  # that came with it, from a recording or ROS
    vehicle: VehicleState | None = None  # the same
    interruptions: int | None = None
    """Of a live camera: how often images stopped for a while, or it was opened again; the latency
    may have changed."""


class CameraGoneError(CameraError):
    """A live camera cannot be opened or delivers no more images; it may come back."""


class ImageSource(Protocol):
    def read(self) -> CameraImage | None:
        """The next image; None at the end. Raises `CameraGoneError`: call again later."""

    def close(self) -> None: ...


class LiveCamera:
    """A device or stream, read by OpenCV. Its images carry their time of arrival."""

    def __init__(
        self,
        name: int | str,
        clocks: Clocks,
        *,
        size_px: tuple[int, int] | None = None,
        capture: Callable[[int | str], Any] | None = None,
    ) -> None:
        self._name, self._clocks, self._size = name, clocks, size_px
        self._shown = f"/dev/video{name}" if isinstance(name, int) else name
        self._opener = capture or _capture
        self._capture: Any = None
        self._number = self._interruptions = 0
        self._last_ns: int | None = None
        self._intervals_s: deque[float] = deque([1.0], maxlen=31)
        # UTC may be set in flight; the times of views must not jump with it.
        self._utc_minus_mono_ns = clocks.utc_ns() - clocks.mono_ns()

    def read(self) -> CameraImage | None:
        if self._capture is None:  # first image, or after the camera was gone
            self._capture = self._open()
        if not self._capture.grab():
            self.close()
            raise CameraGoneError(f"camera delivers no images: {self._shown}")
        arrived_ns = self._clocks.mono_ns()
        self._count_interruptions(arrived_ns)
        self._number += 1
        grey, problem = _loaded(partial(_decoded, self._capture.retrieve(), "image"))
        return CameraImage(
            self._number,
            f"{self._number:08d}",
            arrived_ns,
            arrived_ns + self._utc_minus_mono_ns,
            grey,
            problem,
            interruptions=self._interruptions,
        )

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None
            self._interruptions += 1

    def _count_interruptions(self, arrived_ns: int) -> None:
        before_ns, self._last_ns = self._last_ns, arrived_ns
        if before_ns is None:
            return
        gap_s = (arrived_ns - before_ns) / 1e9
        self._interruptions += gap_s > max(GAP_S, 3.0 * median(self._intervals_s))
        self._intervals_s.append(gap_s)

    def _open(self) -> Any:
        capture = self._opener(self._name)
        if not capture.isOpened():
            capture.release()
            raise CameraGoneError(f"camera cannot be opened: {self._shown}")
        if self._size is not None and isinstance(self._name, int):
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if int(capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"Y16 "):
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # else OpenCV keeps the upper 8 bits
        return capture


class Playback:
    def __init__(
        self,
        images: Iterator["RecordedImage"],
        due_ns: Callable[[int], int | None],
        clocks: Clocks,
        stopped: Callable[[], bool],
    ) -> None:
        """`due_ns`: from times of the recording to our clock; None: not known yet."""
        self._images, self._due_ns = images, due_ns
        self._clocks, self._stopped = clocks, stopped
        self._number = 0

    def read(self) -> CameraImage | None:
        entry = next(self._images, None)
        if entry is None:
            return None
        while not self._stopped():
            due_ns = self._due_ns(entry.time_ns)
            left_s = 0.05 if due_ns is None else (due_ns - self._clocks.mono_ns()) / 1e9
            if due_ns is not None and left_s <= 0:
                return self._picture(entry, due_ns)
            self._clocks.sleep(min(left_s, 0.05))
        return None

    def close(self) -> None: ...

    def _picture(self, entry: "RecordedImage", due_ns: int) -> CameraImage:
        self._number += 1
        grey, problem = _loaded(entry.load)
        return CameraImage(
            self._number, entry.frame, due_ns, entry.time_ns, grey, problem, entry.telemetry
        )


@dataclass(frozen=True, eq=False)
class RecordedImage:
    frame: str
    time_ns: int
    load: Callable[[], Grey]
    telemetry: Telemetry | None = None


def own_pace(clocks: Clocks, pace: float) -> Callable[[int], int]:
    """Playback at `pace` times real time that starts now with the first image."""
    begin: list[int] = []

    def due_ns(time_ns: int) -> int:
        if not begin:
            begin.extend((clocks.mono_ns(), time_ns))
        return begin[0] + round((time_ns - begin[1]) / pace)

    return due_ns


def autopilot_pace(
    boot_ns: Callable[[int], int | None], clocks: Clocks, pace: float
) -> Callable[[int], int | None]:
    """Playback by the autopilot's clock, which `boot_ns` gives; None: not yet known. A warning says
    where the first image is due so late that its time is probably of another clock."""
    warned: list[int] = []

    def due_ns(time_ns: int) -> int | None:
        now_ns = clocks.mono_ns()
        there_ns = boot_ns(now_ns)
        if there_ns is None:
            return None
        ahead_ns = round(time_ns / pace) - there_ns
        if not warned:
            warned.append(ahead_ns)
            if ahead_ns > 60e9:
                log.warning(
                    "the first image is due in %.0f s: are the times of the flight folder those of "
                    "the autopilot since it started? (--recorded-telemetry plays without it)",
                    ahead_ns / 1e9,
                )
        return now_ns + ahead_ns

    return due_ns


def is_live(name: str) -> bool:
    return name.isdigit() or name.startswith(("/dev/", *STREAMS))


def live_name(name: str) -> int | str:
    """Name as OpenCV expects it: a number for a V4L2 device."""
    tail = name.removeprefix("/dev/video")
    return int(tail) if tail.isdigit() else name


def recorded_images(path: Path) -> Iterator[RecordedImage]:
    """Images of a flight folder or a video. Raises `FlightError`, `MissingFileError`."""
    if (path / "telemetry.csv").is_file():
        views = open_flight(path).views
        return iter(
            [RecordedImage(v.frame, v.telemetry.time_ns, v.grey, v.telemetry) for v in views]
        )
    if path.is_dir():
        raise FlightError(f"not a flight folder (no telemetry.csv): {path}")
    if not path.is_file():
        raise MissingFileError(f"no such camera, stream, folder or file: {path}")
    require_file(path, "video")
    capture = _capture(str(path.resolve()))
    if not capture.isOpened():
        raise FlightError(f"video cannot be opened: cut short, or not a video: {path}")
    return _video(capture)


def _video(capture: Any) -> Iterator[RecordedImage]:
    number = 0
    try:
        while capture.grab():
            time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            load = partial(_decoded, capture.retrieve(), f"frame {number} of the video")
            yield RecordedImage(f"{number:06d}", time_ns, load)
            number += 1
    finally:
        capture.release()


def _decoded(retrieved: tuple[bool, Any], what: str) -> Grey:
    found, frame = retrieved
    if not found:
        raise FlightError(f"{what} could not be decoded")
    return grey_levels(frame)


def _loaded(load: Callable[[], Grey]) -> tuple[Grey | None, NoFix | None]:
    """The picture, or why there is none."""
    try:
        return load(), None
    except FlightError as error:  # also a format that was not negotiated
        return None, NoFix("bad_image", str(error))
    except OSError as error:
        return None, NoFix("bad_image", f"image cannot be read ({error})")


def _capture(name: int | str) -> Any:
    if isinstance(name, int):
        return cv2.VideoCapture(name, cv2.CAP_V4L2)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 3000]
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, limits)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the camera describes the sensor
    return capture


class NewestImage:
    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._picture: CameraImage | None = None
        self.taken = self.replaced = self.outages = 0
        self.problem = ""  # why there are none now
        self.ended = False

    def put(self, image: CameraImage) -> None:
        with self._condition:
            self.replaced += self._picture is not None
            self.taken += 1
            self._picture = image
            self._condition.notify()

    def end(self) -> None:
        with self._condition:
            self.ended = True
            self._condition.notify()

    def take(self, timeout_s: float) -> CameraImage | None:
        """Newest image, each at most once; None where none came within `timeout_s`."""
        with self._condition:
            if self._picture is None and not self.ended:
                self._condition.wait(timeout_s)
            image, self._picture = self._picture, None
            return image

    @property
    def is_over(self) -> bool:
        with self._condition:
            return self.ended and self._picture is None


def read_into(
    newest: NewestImage,
    source: ImageSource,
    stopped: Callable[[], bool],
    pause: Callable[[float], object],
) -> None:
    """Read until the end or until stopped; where the camera is gone, retry after a pause."""
    failures = 0
    try:
        while not stopped():
            try:
                image = source.read()
            except Exception as error:  # unplugged, or a fault of the driver: it may come back
                newest.problem = str(error)
                if failures == 0:
                    newest.outages += 1
                    expected = isinstance(error, CameraGoneError)
                    log.warning("camera: %s", error, exc_info=not expected)
                source.close()
                pause(retry_s(failures))
                failures += 1
                continue
            if image is None:
                break
            failures = 0
            newest.put(image)
    finally:
        source.close()
        newest.end()


def read_in_thread(
    newest: NewestImage, source: ImageSource, stopping: threading.Event
) -> Callable[[], None]:
    """The function that stops it; it does not wait for a device that does not answer."""
    arguments = newest, source, stopping.is_set, stopping.wait
    thread = threading.Thread(target=read_into, args=arguments, name="camera", daemon=True)
    thread.start()

    def stop() -> None:
        stopping.set()
        thread.join(2.0)

    return stop


class FrozenCheck:
    """Detects repeated images: a camera that hangs would look like an aircraft that hovers."""

    def __init__(self) -> None:
        self._before: Grey | None = None
        self.repeats = 0

    def is_repeat(self, grey: Grey) -> bool:
        step = max(1, min(grey.shape) // 64)
        sample = np.ascontiguousarray(grey[step // 2 :: step, step // 2 :: step])
        before, self._before = self._before, sample
        same = False
        if before is not None and before.shape == sample.shape:
            off = np.abs(before.astype(np.int16) - sample)
            # Noise of a camera makes four times as many grey levels.
            same = not off.any() or (off.mean() < 0.25 and sample.std() > 0)
        self.repeats = self.repeats + 1 if same else 0
        return bool(same)
