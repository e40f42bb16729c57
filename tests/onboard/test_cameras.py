"""Images: the newest one, its time of exposure, and faults of cameras."""

import cv2
import numpy as np
import pytest
from benchmarks.fakes import Stream
from fake_autopilot import UTC_NS, S, Time, write_flight

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry
from orthonav.onboard.cameras import (
    CameraImage,
    FrozenCheck,
    LiveCamera,
    NewestImage,
    Playback,
    RecordedImage,
    autopilot_pace,
    own_pace,
    read_into,
    recorded_images,
)


def noisy(seed, shape=(240, 320)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def image(number, grey=None):
    return CameraImage(number, str(number), number * S, number * S, grey)


class Device(Stream):
    """A camera as OpenCV gives it, that may be "absent" or "dead"."""

    def __init__(self, frames):
        self.frames, self.released, self.settings = list(frames), False, {}

    def isOpened(self):
        return not (len(self.frames) == 1 and isinstance(self.frames[0], str))

    def grab(self):
        return bool(self.frames) and not isinstance(self.frames[0], str)

    def retrieve(self):
        frame = self.frames.pop(0)
        return frame is not None, frame

    def set(self, name, value):
        self.settings[name] = value

    def release(self):
        self.released = True


def test_images_of_a_live_camera_carry_their_arrival():
    time = Time()
    device = Device([noisy(0), np.dstack([noisy(1)] * 3), None])
    camera = LiveCamera(0, time.clocks, size_px=(320, 240), capture=lambda _: device)
    first = camera.read()
    assert first.exposed_ns == time.now_ns
    assert first.time_ns == UTC_NS + first.exposed_ns
    time.go(1.0)
    time.utc_ahead_ns += 3600 * S  # the clock is set while we fly
    second = camera.read()
    assert second.time_ns - first.time_ns == S
    np.testing.assert_array_equal(second.grey, noisy(1))
    third = camera.read()
    assert third.grey is None and third.problem.reason == "bad_image"
    assert device.settings[cv2.CAP_PROP_FRAME_WIDTH] == 320


def test_images_that_stop_for_a_while_are_interruptions():
    def interruptions(intervals_s):
        time, device = Time(), Device([noisy(0)] * len(intervals_s))
        camera, found = LiveCamera(0, time.clocks, capture=lambda _: device), []
        for each in intervals_s:
            time.go(each)
            found.append(camera.read().interruptions)
        return found

    assert interruptions([0.1, 0.2] * 20) == [0] * 40
    assert interruptions([0.1] * 10 + [2.0] + [0.1] * 5) == [0] * 16  # positions show it
    assert interruptions([0.1] * 10 + [4.0] + [0.1] * 5) == [0] * 10 + [1] * 6
    assert interruptions([1.0] * 10) == [0] * 10  # a slow camera


def test_a_camera_that_stops_comes_back():
    time, opened = Time(), []
    lives = [[noisy(0), "dead"], ["absent"], ["absent"], [noisy(1), noisy(2), "dead"]]

    def capture(_):
        opened.append(Device(lives[len(opened)] if len(opened) < len(lives) else ["absent"]))
        return opened[-1]

    newest, pauses = NewestImage(), []
    camera = LiveCamera(0, time.clocks, capture=capture)
    read_into(newest, camera, lambda: len(opened) > 5, pauses.append)
    assert newest.taken == 3 and newest.outages == 2
    assert pauses[:3] == [0.5, 1.0, 2.0] and pauses[3] == 0.5
    assert all(each.released for each in opened)
    last = newest.take(0)
    assert last.number == 3 and last.interruptions > 0 and newest.is_over


def test_a_camera_is_retried_after_a_fault_of_its_driver(caplog):
    class Odd:
        asked = closed = 0

        def read(self):
            self.asked += 1
            if self.asked < 4:
                raise ZeroDivisionError("driver")
            return image(1) if self.asked == 4 else None

        def close(self):
            self.closed += 1

    newest, odd = NewestImage(), Odd()
    read_into(newest, odd, lambda: False, lambda _: None)
    assert (newest.taken, newest.outages, odd.closed) == (1, 1, 4)
    assert caplog.text.count("Traceback") == 1


def entries(*times_s):
    return iter([RecordedImage(f"{t}", round(t * S), lambda: noisy(0)) for t in times_s])


@pytest.mark.parametrize("pace", [1.0, 4.0])
def test_a_recording_is_played_in_real_time(pace):
    time = Time()
    source = Playback(
        entries(50.0, 50.5, 53.0), own_pace(time.clocks, pace), time.clocks, lambda: False
    )
    begin, seen = time.now_ns, []
    while (one := source.read()) is not None:
        assert time.now_ns >= one.exposed_ns
        seen.append(((one.exposed_ns - begin) / S, one.time_ns / S))
    assert seen == [(0.0, 50.0), (0.5 / pace, 50.5), (3.0 / pace, 53.0)]


def test_a_recording_can_follow_the_clock_of_the_autopilot():
    time = Time()
    offset = [None]

    def boot_ns(mono_ns):
        if time.now_ns > 101 * S:  # not heard before
            offset[0] = -95 * S
        return None if offset[0] is None else mono_ns + offset[0]

    due_ns = autopilot_pace(boot_ns, time.clocks, 2.0)
    source = Playback(entries(14.0, 15.0), due_ns, time.clocks, lambda: False)
    assert [source.read().exposed_ns for _ in range(2)] == [102 * S, 102 * S + S // 2]


@pytest.mark.parametrize("first_s", [150.0, 1.7e9])
def test_times_of_another_clock_than_the_autopilots_are_named(first_s, caplog):
    time = Time()
    due_ns = autopilot_pace(lambda _: 100 * S, time.clocks, 1.0)
    ahead_s = round(first_s - 100)
    assert [due_ns(round(each * S)) - time.now_ns for each in (first_s, first_s + 70)] == [
        ahead_s * S,
        (ahead_s + 70) * S,
    ]
    assert caplog.text.count("first image is due in") == (first_s > 160)


@pytest.fixture
def rows(tmp_path):
    """Telemetry of a flight folder with three images."""
    rows = [Telemetry(n * S + n, 10.0 * n, 1.0, -2.0, 100.0 + n) for n in range(3)]
    camera = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
    write_flight(tmp_path, camera, [(noisy(n), row) for n, row in enumerate(rows)])
    return rows


def test_flight_folders_have_times_and_telemetry(rows, tmp_path):
    images = list(recorded_images(tmp_path))
    assert [(each.time_ns, each.telemetry) for each in images] == [(r.time_ns, r) for r in rows]
    np.testing.assert_array_equal(images[2].load(), noisy(2))


def test_an_incomplete_image_is_a_bad_image(rows, tmp_path):
    time, images = Time(), list(recorded_images(tmp_path))
    cut, gone = (next(tmp_path.rglob(each.frame)) for each in images[1:])
    cut.write_bytes(cut.read_bytes()[:2000])
    gone.unlink()
    source = Playback(iter(images), own_pace(time.clocks, 1.0), time.clocks, lambda: False)
    seen = [source.read() for _ in range(4)]
    assert seen[0].grey is not None and seen[3] is None
    for each in seen[1:3]:
        assert each.grey is None and each.problem.reason == "bad_image"
    assert seen[2].exposed_ns - seen[0].exposed_ns == rows[2].time_ns


def test_a_video_has_its_own_times(tmp_path):
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for number in range(4):
        writer.write(np.dstack([np.full((240, 320), 40 * number, np.uint8)] * 3))
    writer.release()
    found = list(recorded_images(path))
    assert [each.time_ns for each in found] == [0, S // 10, S // 5, 3 * S // 10]
    assert [round(float(each.load().mean()) / 40) for each in found] == [0, 1, 2, 3]


def test_invalid_sources_are_refused(tmp_path):
    with pytest.raises(MissingFileError):
        recorded_images(tmp_path / "nothing")
    with pytest.raises(FlightError, match="not a flight folder"):
        recorded_images(tmp_path)
    (tmp_path / "x.mp4").write_bytes(b"no video")
    with pytest.raises(FlightError, match="video"):
        recorded_images(tmp_path / "x.mp4")


def ground(seed=0):
    return cv2.GaussianBlur(noisy(seed, (480, 640)), (0, 0), 4)


def sensed(scene, seed):
    noise = np.random.default_rng(seed).normal(0, 1.0, scene.shape)
    return np.clip(scene + noise, 0, 255).astype(np.uint8)


def test_an_equal_or_nearly_equal_image_is_frozen():
    scene = ground()
    check = FrozenCheck()
    assert not check.is_repeat(scene)
    assert check.is_repeat(scene.copy()) and check.is_repeat(scene.copy())
    assert check.repeats == 2
    nearly = scene.copy()
    nearly[::7, ::7] += 1  # compressed again
    assert check.is_repeat(nearly)
    assert not check.is_repeat(ground(1)) and check.repeats == 0


def test_hovering_is_not_frozen():
    """The same scene with the noise of a good sensor, one grey level."""
    scene, check = ground(), FrozenCheck()
    assert not any(check.is_repeat(sensed(scene, seed)) for seed in range(10))
