"""Images of a ROS 2 graph with the telemetry of their exposure: an `ImageSource` for the runner.

An image waits a little for the attitude that follows its exposure. Times are ROS time, that of the
header stamps; for a message without a stamp the time of arrival is used.
"""

import logging
import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

from orthonav.core.errors import CameraError, FlightError, StoppedError
from orthonav.core.flight.gnss import FIX_3D, GnssSample
from orthonav.core.flight.ros_messages import (
    TIME_NS,
    attitude_of_message,
    camera_of_info,
    grey_of_message,
    height_of_message,
    horizon_std_of_message,
    odd_word,
    stamp_ns,
)
from orthonav.core.geo.attitude import LOOKS_DOWN, Angles, ned_wxyz_from_ros
from orthonav.core.geo.camera import Camera
from orthonav.core.records import NoFix
from orthonav.core.tilt import AUTOPILOT
from orthonav.onboard.cameras import CameraImage
from orthonav.onboard.ros2.node import Node
from orthonav.onboard.telemetry import FIX_NS, Clocks, TelemetryBuffer

log = logging.getLogger(__name__)
JUMP_NS = TIME_NS
"""Stamps that go back by more show a restart: a simulation was reset, or a bag played again."""
FAR_NS = 2 * TIME_NS
"""Images whose stamps differ from now by more are stamped by another clock."""
WAIT_NS = 150_000_000
"""Longest wait of an image for the attitude that follows its exposure."""
REMIND_S = 10.0
"""Seconds between two log lines about a missing input."""
MOST_LINES = 100
"""Largest number of different log lines about messages, whose contents are untrusted."""
_SPIN_S = 0.05
_TELEMETRY_DEPTH = 200
IMAGES = {"raw": "sensor_msgs/msg/Image", "compressed": "sensor_msgs/msg/CompressedImage"}
LOST_WINDOW_NS, LOST_SHARE, LEAST_IMAGES = 10 * TIME_NS, 0.2, 5
"""Share of the last seconds' images that may be lost, and the least number that shows it."""
IRREGULAR = 2
"""A node between passes every n-th image on where steps from image to image, in messages of the
camera, differ by less."""
_LOSES = (
    "loses images: use compressed ones, image_reliability:=reliable, or a larger net.core.rmem_max"
)


def loses_images(image_stamps_ns: Sequence[int], info_stamps_ns: Sequence[int]) -> bool:
    """Whether more than `LOST_SHARE` of the images are missing beside their `camera_info`.

    A camera gives both the same stamp. An image is sent in many parts and lost with one of them,
    its `camera_info` is a single part.
    """
    images, infos = sorted(image_stamps_ns), sorted(info_stamps_ns)
    if images:
        images = images[bisect_left(images, images[-1] - LOST_WINDOW_NS) :]
    if len(images) < LEAST_IMAGES:
        return False
    steps = [bisect_right(infos, b) - bisect_right(infos, a) for a, b in pairwise(images)]
    lost = sum(max(step - 1, 0) for step in steps)
    return lost > LOST_SHARE * (lost + len(images)) and max(steps) - min(steps) >= IRREGULAR


@dataclass(frozen=True, eq=False)
class _WaitingImage:
    message: Any
    stamp_ns: int
    arrived_ns: int


class Ros2Reader:
    """Camera, attitude, heights and GNSS of a ROS 2 graph. `read` is for one thread. Mutable."""

    def __init__(
        self,
        node: Node,
        buffer: TelemetryBuffer,
        clocks: Clocks,
        stopped: Callable[[], bool],
        *,
        mount_deg: Angles = LOOKS_DOWN,
    ) -> None:
        self._node, self._buffer, self._clocks, self._stopped = node, buffer, clocks, stopped
        self._mount_deg = mount_deg
        self.gnss: deque[GnssSample] = deque(maxlen=1000)  # for `orthonav.onboard.gnss`
        self.log_gnss: Callable[[int, bytes], None] = lambda time_ns, cdr: None
        self.report_wait: Callable[[str], None] = lambda why: None  # once a second
        self._camera: Camera | None = None
        self._camera_error: CameraError | None = None
        self._images: deque[_WaitingImage] = deque()
        self._image_stamps: deque[int] = deque(maxlen=1000)
        self._info_stamps: deque[int] = deque(maxlen=1000)
        self._clock: tuple[int, int] | None = None
        self._number, self._image_ns, self._attitude_ns = 0, 0, 0
        self._checked_ns = self._reminded_ns = clocks.mono_ns()
        self._stated_horizon_deg: float | None = None
        self._fixed_ns = -math.inf  # `gnss` is emptied by who compares it
        self._said: set[str] = set()
        self._subscribe()

    def wait_for_camera(self) -> Camera:
        """Camera of the first `camera_info`; waits for it until stopped, and logs that.

        Raises `CameraError` where it is not calibrated, `StoppedError` where the flight was stopped
        before.
        """
        why, reported_ns = f"no message on {self._info_topic}; or give --camera FILE", 0
        while not self._stopped():
            if self._clocks.mono_ns() - reported_ns >= TIME_NS:
                reported_ns = self._clocks.mono_ns()
                self.report_wait(why)
            self._spin()
            if self._camera_error is not None:
                raise CameraError(f"{self._camera_error}: {self._info_topic}")
            if self._camera is not None:
                return self._camera
            self._remind(why)
        raise StoppedError(
            f"stopped before a camera_info came; give --camera FILE: {self._info_topic}"
        )

    def read(self) -> CameraImage | None:
        while not self._stopped():
            self._spin()
            if self._images and self._is_ready(self._images[0]):
                return self._camera_image(self._images.popleft())
            if self._node.parameters.use_sim_time and self._clock is None:
                self._remind("use_sim_time is true and nothing came on /clock")
            elif not self._images and self._number == 0:
                self._remind(f"no images on {self._image_topic}")
        return None

    def close(self) -> None:
        """See `ImageSource.close`; the node is closed by its owner."""

    def now_ns(self) -> int:
        """ROS time; 0 before the first `/clock`, as ROS defines it."""
        ahead_ns = self._ahead_ns()
        return 0 if ahead_ns is None else self._clocks.mono_ns() + ahead_ns

    def _subscribe(self) -> None:
        node, parameters = self._node, self._node.parameters
        resolved = node.resolved
        image, kind = resolved("image"), IMAGES[parameters.image_transport]
        compressed = parameters.image_transport == "compressed"
        self._image_topic = f"{image}/compressed" if compressed else image
        beside = f"{image.rpartition('/')[0]}/camera_info"
        is_remapped = node.is_remapped("camera_info")
        self._info_topic = resolved("camera_info") if is_remapped else beside
        reliable = parameters.image_reliability == "reliable"
        node.subscribe(self._image_topic, kind, self._take_image, reliable=reliable)
        for topic, kind, handler in (
            (self._info_topic, "sensor_msgs/msg/CameraInfo", self._take_camera_info),
            (resolved("imu"), "sensor_msgs/msg/Imu", self._take_attitude),
            (resolved("range"), "sensor_msgs/msg/Range", partial(self._take_height, "distance")),
            (resolved("rel_alt"), "std_msgs/msg/Float64", partial(self._take_height, "home")),
            (resolved("gnss"), "sensor_msgs/msg/NavSatFix", self._take_gnss),
        ):
            node.subscribe(topic, kind, handler, depth=_TELEMETRY_DEPTH)
        if parameters.use_sim_time:
            clock = "rosgraph_msgs/msg/Clock"
            node.subscribe(resolved("/clock"), clock, self._take_clock, depth=1)

    def _spin(self) -> None:
        self._node.spin(_SPIN_S)
        now_ns = self._clocks.mono_ns()
        if now_ns - self._checked_ns >= TIME_NS:
            self._checked_ns = now_ns
            lost = loses_images(self._image_stamps, self._info_stamps)
            losing = {self._image_topic: _LOSES} if lost else {}
            self._node.note({**losing, **self._node.wrong_types()})

    def _ahead_ns(self) -> int | None:
        """ROS time minus our monotonic clock; None before the first `/clock`."""
        if not self._node.parameters.use_sim_time:
            return self._clocks.utc_ns() - self._clocks.mono_ns()
        return None if self._clock is None else self._clock[0] - self._clock[1]

    def _stamp(self, message: Any) -> int | None:
        """Time of a message: its stamp, else its arrival; None while ROS time is unknown."""
        ahead_ns = self._ahead_ns()
        if ahead_ns is None:
            return None
        return stamp_ns(message, self._clocks.mono_ns() + ahead_ns)

    def _take_clock(self, message: Any, cdr: bytes) -> None:
        time_ns = int(message.clock.sec) * TIME_NS + int(message.clock.nanosec)
        if self._clock is not None and time_ns < self._clock[0] - JUMP_NS:
            self._restart("/clock", self._clock[0] - time_ns)
        self._clock = time_ns, self._clocks.mono_ns()

    def _take_image(self, message: Any, cdr: bytes) -> None:
        """Keep the oldest waiting image and the newest one."""
        time_ns = self._stamp(message)
        if time_ns is None:
            return
        if time_ns <= self._image_ns:
            if self._image_ns - time_ns < JUMP_NS:
                self._say_once(f"stamps of images go back; dropped: {self._image_topic}")
                return
            self._restart(self._image_topic, self._image_ns - time_ns)
        self._image_ns = time_ns
        self._image_stamps.append(time_ns)
        while len(self._images) > 1:
            self._images.pop()
        self._images.append(_WaitingImage(message, time_ns, self._clocks.mono_ns()))

    def _take_camera_info(self, message: Any, cdr: bytes) -> None:
        """Use the first one: the camera does not change in flight."""
        self._info_stamps.append(stamp_ns(message, 0))
        if self._camera is None:
            try:
                self._camera = camera_of_info(message, self._image_topic)
            except CameraError as error:
                self._camera_error = error

    def _take_attitude(self, message: Any, cdr: bytes) -> None:
        time_ns, wxyz = self._stamp(message), attitude_of_message(message)
        if self._is_odd("imu", message, missing=wxyz is None) or time_ns is None or wxyz is None:
            return
        if time_ns < self._attitude_ns - JUMP_NS:
            self._restart("imu", self._attitude_ns - time_ns)
        self._attitude_ns = max(self._attitude_ns, time_ns)
        self._stated_horizon_deg = horizon_std_of_message(message)
        turned = ned_wxyz_from_ros(wxyz)
        if turned is not None:
            self._buffer.add_attitude(time_ns, turned.tolist())

    def _is_odd(self, what: str, message: Any, *, missing: bool = False) -> bool:
        word = odd_word(message)
        if word or missing:
            why = f"its frame is named '{word}'" if word else "it has no orientation"
            self._say_once(f"{what} is not used: {why}")
        return bool(word)

    def _take_height(self, source: str, message: Any, cdr: bytes) -> None:
        time_ns, height = self._stamp(message), height_of_message(message)
        if self._is_odd(source, message) or time_ns is None or height is None:
            return
        if source == "distance":
            self._buffer.add_distance(time_ns, height)
        else:
            self._buffer.add_height(source, time_ns, height)

    def _take_gnss(self, message: Any, cdr: bytes) -> None:
        time_ns = self._stamp(message)
        if time_ns is not None:
            known, has_fix = int(message.position_covariance_type) > 0, message.status.status >= 0
            self._fixed_ns = self._clocks.mono_ns() if has_fix else -math.inf
            variance_m2 = max(float(message.position_covariance[i]) for i in (0, 4))
            self.gnss.append(
                GnssSample(
                    time_ns=time_ns - (self._ahead_ns() or 0),
                    arrived_ns=self._clocks.mono_ns(),
                    lat_deg=float(message.latitude),
                    lon_deg=float(message.longitude),
                    fix_type=FIX_3D if has_fix else 1,
                    std_m=math.sqrt(variance_m2) if known and variance_m2 > 0 else math.nan,
                    stamp_ns=time_ns,
                )
            )
            self.log_gnss(time_ns, cdr)

    def _is_ready(self, image: _WaitingImage) -> bool:
        covered_ns = self._buffer.covered_ns
        if covered_ns is not None and covered_ns >= image.stamp_ns:
            return True
        return self._clocks.mono_ns() - image.arrived_ns >= WAIT_NS

    def _camera_image(self, image: _WaitingImage) -> CameraImage:
        self._number += 1
        exposed_ns = image.stamp_ns - (self._ahead_ns() or 0)
        if abs(self._clocks.mono_ns() - exposed_ns) > FAR_NS:
            self._say_once(
                f"stamps of images differ from ROS time by more than {FAR_NS / TIME_NS:g} s: set "
                "use_sim_time for recordings and simulations, or synchronize the clocks: "
                f"{self._image_topic}"
            )
        grey, problem = None, None
        try:
            grey = grey_of_message(image.message, self._image_topic)
        except FlightError as error:
            problem = NoFix("bad_image", str(error))
            self._say_once(str(error))
        vehicle = self._buffer.at(image.stamp_ns)
        vehicle = replace(vehicle, horizon_std_deg=self._horizon_std_deg())
        return CameraImage(
            self._number,
            f"{image.stamp_ns}",
            exposed_ns,
            image.stamp_ns,
            grey,
            problem,
            vehicle.telemetry(image.stamp_ns, self._mount_deg),
            vehicle,
        )

    def _horizon_std_deg(self) -> float:
        """As stated, else by whether a receiver has a fix."""
        if self._stated_horizon_deg is not None:
            return self._stated_horizon_deg
        is_aided = self._clocks.mono_ns() - self._fixed_ns <= FIX_NS
        return AUTOPILOT.aided_deg if is_aided else AUTOPILOT.unaided_deg

    def _restart(self, what: str, back_ns: int) -> None:
        """Discard telemetry and images: time went back, they belong to an earlier run."""
        log.warning("ROS time went back by %.1f s (%s); telemetry is cleared", back_ns / 1e9, what)
        self._buffer.clear()
        for held in (self._images, self._image_stamps, self._info_stamps):
            held.clear()
        self._image_ns = self._attitude_ns = 0

    def _remind(self, text: str) -> None:
        now_ns = self._clocks.mono_ns()
        pause_s = REMIND_S if text in self._said else 1.0  # discovery takes a moment
        if now_ns - self._reminded_ns >= pause_s * 1e9:
            self._said.add(text)
            self._reminded_ns = now_ns
            log.warning("waiting: %s", text)

    def _say_once(self, text: str) -> None:
        if text not in self._said and len(self._said) < MOST_LINES:
            self._said.add(text)
            log.warning("%s", text)
