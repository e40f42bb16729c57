"""Pictures as a camera takes them: devices, streams, and recordings at their own pace.

A thread reads; who asks gets the newest picture, and what came between is counted. A picture knows
when it was exposed, by our monotonic clock, until the message that is made of it.
"""

import logging
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.errors import CameraError, FlightError, MissingFileError
from orthonav.flight import decode_image, open_flight
from orthonav.onboard.telemetry import Clocks, Told
from orthonav.records import NoFix, Telemetry

log = logging.getLogger(__name__)
RETRY_S = (0.5, 1.0, 2.0, 5.0)
STREAMS = ("rtsp://", "rtsps://", "http://", "https://", "udp://", "tcp://")
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
FROZEN_LEVELS = 0.25
"""Pictures that differ by less than this on average are one: noise alone is four times as much."""
FROZEN_SIDE_PX = 64
_OPEN_MS, _READ_MS = 5000.0, 3000.0
Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture: `grey` (H, W), or `problem` where it could not be decoded.

    `exposed_ns` is the exposure by our monotonic clock; `time_ns` what is written of it: UTC of a
    live camera, the recording's own time else. `telemetry` is what came with it, from a
    recording or from ROS, and `reported` the attitude of the vehicle behind that.
    """

    number: int
    frame: str
    exposed_ns: int
    time_ns: int
    grey: Grey | None
    problem: NoFix | None = None
    telemetry: Telemetry | None = None
    reported: Told | None = None


class CameraGoneError(CameraError):
    """A live camera cannot be opened, or gives no more pictures; it may come back."""


class Source(Protocol):
    """Where pictures come from."""

    def read(self) -> Picture | None:
        """The next one, as soon as it is there; None at the end, or where it was stopped.

        Raises `CameraGoneError`: ask again later.
        """

    def close(self) -> None:
        """Let go of the device."""


class LiveCamera:
    """A device or stream through OpenCV. Exposure is arrival less a latency that was measured."""

    def __init__(
        self,
        name: int | str,
        clocks: Clocks,
        *,
        latency_s: float = 0.0,
        size_px: tuple[int, int] | None = None,
        capture: Callable[[int | str], Any] | None = None,
    ) -> None:
        self._name, self._clocks, self._size = name, clocks, size_px
        self._latency_ns = round(latency_s * 1e9)
        self._opener = capture or _capture
        self._capture: Any = None
        self._number = 0
        # UTC may be set while we fly; what is written of views must not jump with it.
        self._utc_minus_mono_ns = clocks.utc_ns() - clocks.mono_ns()

    def read(self) -> Picture | None:
        """See `Source.read`."""
        if self._capture is None:
            self._capture = self._open()
        if not self._capture.grab():
            self.close()
            raise CameraGoneError(f"camera gives no pictures: {self._name}")
        exposed_ns = self._clocks.mono_ns() - self._latency_ns
        found, frame = self._capture.retrieve()
        self._number += 1
        grey = _grey(frame) if found else None
        problem = None if grey is not None else NoFix("bad_image", "picture could not be decoded")
        return Picture(
            self._number,
            f"{self._number:08d}",
            exposed_ns,
            exposed_ns + self._utc_minus_mono_ns,
            grey,
            problem,
        )

    def close(self) -> None:
        """See `Source.close`."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _open(self) -> Any:
        capture = self._opener(self._name)
        if not capture.isOpened():
            capture.release()
            raise CameraGoneError(f"camera cannot be opened: {self._name}")
        if self._size is not None and isinstance(self._name, int):
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        return capture


class Recorded:
    """Pictures of a recording, each at its time."""

    def __init__(
        self,
        entries: Iterator["Entry"],
        due_ns: Callable[[int], int | None],
        clocks: Clocks,
        stopped: Callable[[], bool],
    ) -> None:
        """`due_ns` says when, by our clock, a time of the recording comes; None: not yet known."""
        self._entries, self._due_ns = entries, due_ns
        self._clocks, self._stopped = clocks, stopped
        self._number = 0

    def read(self) -> Picture | None:
        """See `Source.read`."""
        entry = next(self._entries, None)
        if entry is None:
            return None
        while not self._stopped():
            due_ns = self._due_ns(entry.time_ns)
            left_s = 0.05 if due_ns is None else (due_ns - self._clocks.mono_ns()) / 1e9
            if due_ns is not None and left_s <= 0:
                return self._picture(entry, due_ns)
            self._clocks.sleep(min(left_s, 0.05))
        return None

    def close(self) -> None:
        """See `Source.close`."""

    def _picture(self, entry: "Entry", due_ns: int) -> Picture:
        self._number += 1
        grey, problem = None, None
        try:
            grey = entry.load()
        except FlightError as error:
            problem = NoFix("bad_image", str(error))
        except OSError as error:
            problem = NoFix("bad_image", f"picture cannot be read ({error})")
        return Picture(
            self._number, entry.frame, due_ns, entry.time_ns, grey, problem, entry.telemetry
        )


@dataclass(frozen=True, eq=False)
class Entry:
    """One picture of a recording before it is decoded."""

    frame: str
    time_ns: int
    load: Callable[[], Grey]
    telemetry: Telemetry | None = None


def own_pace(clocks: Clocks, pace: float) -> Callable[[int], int]:
    """Times of a recording by our clock: its first picture comes now, the others as they did.

    `pace` is how much faster.
    """
    begin: list[int] = []

    def due_ns(time_ns: int) -> int:
        if not begin:
            begin.extend((clocks.mono_ns(), time_ns))
        return begin[0] + round((time_ns - begin[1]) / pace)

    return due_ns


def autopilot_pace(
    boot_ns: Callable[[int], int | None], clocks: Clocks, pace: float
) -> Callable[[int], int | None]:
    """The same where times of the recording are those of the autopilot's clock, as a simulation
    has them. `boot_ns` takes our clock to the autopilot's, None while that is not known."""

    def due_ns(time_ns: int) -> int | None:
        now_ns = clocks.mono_ns()
        there_ns = boot_ns(now_ns)
        return None if there_ns is None else now_ns + round(time_ns / pace) - there_ns

    return due_ns


def is_live(name: str) -> bool:
    """Whether this names a device or a stream, and not a recording."""
    return name.isdigit() or name.startswith(("/dev/", *STREAMS))


def live_name(name: str) -> int | str:
    """The name as OpenCV wants it: a number for a V4L2 device."""
    tail = name.removeprefix("/dev/video")
    return int(tail) if tail.isdigit() else name


def recorded_entries(path: Path, rate_hz: float) -> Iterator[Entry]:
    """The pictures of a flight folder (its own times), a folder of images (`rate_hz`, by name), or
    a video. Raises `FlightError` or `MissingFileError` at once where it is none of them."""
    if (path / "telemetry.csv").is_file():
        views = open_flight(path).views
        return iter([Entry(v.frame, v.telemetry.time_ns, v.grey, v.telemetry) for v in views])
    if path.is_dir():
        return _images(path, rate_hz)
    if not path.is_file():
        raise MissingFileError(f"no such camera, stream, folder or file: {path}")
    capture = _capture(str(path.resolve()))
    if not capture.isOpened():
        raise FlightError(f"video cannot be opened: cut short, or not a video: {path}")
    return _video(capture)


def _images(folder: Path, rate_hz: float) -> Iterator[Entry]:
    paths = sorted(each for each in folder.iterdir() if each.suffix.lower() in PICTURES)
    if not paths:
        raise FlightError(f"folder holds no pictures ({', '.join(PICTURES)}): {folder}")

    def loader(path: Path) -> Callable[[], Grey]:
        return lambda: decode_image(path.read_bytes(), str(path))

    return iter([Entry(p.name, round(i / rate_hz * 1e9), loader(p)) for i, p in enumerate(paths)])


def _video(capture: Any) -> Iterator[Entry]:
    number = 0
    try:
        while capture.grab():
            time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            found, frame = capture.retrieve()
            grey = _grey(frame) if found else None
            yield Entry(f"{number:06d}", time_ns, _loaded(grey, number))
            number += 1
    finally:
        capture.release()


def _loaded(grey: Grey | None, number: int) -> Callable[[], Grey]:
    def load() -> Grey:
        if grey is None:
            raise FlightError(f"frame {number} of the video cannot be decoded")
        return grey

    return load


def _grey(frame: NDArray[Any]) -> Grey:
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    return np.asarray(grey, dtype=np.uint8)


def _capture(name: int | str) -> Any:
    if isinstance(name, int):
        return cv2.VideoCapture(name, cv2.CAP_V4L2)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MS]
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, [int(number) for number in limits])
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the camera describes the sensor
    return capture


class Newest:
    """The newest picture between the thread that reads and the one that asks."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._picture: Picture | None = None
        self.taken = self.replaced = self.outages = 0
        self.ended = False

    def put(self, picture: Picture) -> None:
        """A picture came; one that nobody asked for is dropped and counted."""
        with self._condition:
            self.replaced += self._picture is not None
            self.taken += 1
            self._picture = picture
            self._condition.notify()

    def end(self) -> None:
        """No more pictures will come."""
        with self._condition:
            self.ended = True
            self._condition.notify()

    def take(self, timeout_s: float) -> Picture | None:
        """The newest picture, once; None where none came in time."""
        with self._condition:
            if self._picture is None and not self.ended:
                self._condition.wait(timeout_s)
            picture, self._picture = self._picture, None
            return picture

    @property
    def is_over(self) -> bool:
        """Whether the last picture of a recording was taken."""
        with self._condition:
            return self.ended and self._picture is None


def read_into(
    newest: Newest, source: Source, stopped: Callable[[], bool], pause: Callable[[float], object]
) -> None:
    """Read until the end or until stopped; a camera that is gone is asked again after a pause."""
    failures = 0
    try:
        while not stopped():
            try:
                picture = source.read()
            except Exception as error:  # gone, or a driver with a fault: it may come back
                if failures == 0:
                    newest.outages += 1
                    expected = isinstance(error, CameraGoneError)
                    log.warning("camera: %s", error, exc_info=not expected)
                source.close()
                pause(RETRY_S[min(failures, len(RETRY_S) - 1)])
                failures += 1
                continue
            if picture is None:
                break
            failures = 0
            newest.put(picture)
    finally:
        source.close()
        newest.end()


class CameraThread:
    """Reads a source into a `Newest` until it is stopped."""

    def __init__(self, source: Source, stopping: threading.Event) -> None:
        self.newest, self._stopping = Newest(), stopping
        arguments = self.newest, source, stopping.is_set, stopping.wait
        self._thread = threading.Thread(
            target=read_into, args=arguments, name="camera", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop; a device that does not answer is left behind."""
        self._stopping.set()
        self._thread.join(2.0)


class FrozenCheck:
    """Tells pictures that are the one before again: a camera that hangs would look like a hover."""

    def __init__(self) -> None:
        self._before: Grey | None = None
        self._sum = 0
        self.repeats = 0

    def is_repeat(self, grey: Grey) -> bool:
        """Whether this picture is the one before it, to the bit or nearly."""
        step = max(1, min(grey.shape) // FROZEN_SIDE_PX)
        sample = np.ascontiguousarray(grey[step // 2 :: step, step // 2 :: step])
        total = zlib.crc32(sample.tobytes())
        before, self._before = self._before, sample
        same = before is not None and before.shape == sample.shape and self._sum == total
        if before is not None and before.shape == sample.shape and not same:
            off = np.abs(before.astype(np.int16) - sample)
            same = float(off.mean()) < FROZEN_LEVELS and sample.std() > 0
        self._sum = total
        self.repeats = self.repeats + 1 if same else 0
        return bool(same)
