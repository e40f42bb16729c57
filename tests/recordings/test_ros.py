"""ROS 1 and ROS 2 recordings and MCAP files: topics, images, cameras, and what is broken."""

import bz2
import math
import tracemalloc
from io import BytesIO

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from bags import FORMATS, Messages, flight, record
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_bytes import MAGIC, MB, chunk, header, line, zeros
from recorders import START_S, camera_file, picture, px4_topics, ulog
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.flight.ros_messages import camera_of_info, grey_of_image
from orthonav.ground.recordings import SourceOptions, import_flight, open_source, ros
from orthonav.ground.recordings.ros import bound_inflation

MIDDLE = (START_S * 2 + 1) * 5 * 10**8  # of the first image: half a second


@pytest.fixture
def messages():
    return Messages()


@pytest.fixture
def topics(messages):
    return flight(messages)


@pytest.mark.parametrize("form", [*FORMATS, "file"])
def test_every_format(tmp_path, form):
    messages = Messages(ros1=form == "bag")
    path = record(tmp_path / "flight", flight(messages), messages, form)
    recording = open_source(path)
    assert recording.kind == "ros" and recording.expected == 4 and recording.warnings == ()
    assert "image /cam/image_raw" in recording.note and "attitude /imu/data" in recording.note
    done = import_flight(recording, tmp_path / "out")
    assert (done.views, done.complete, done.with_truth, done.broken) == (4, 4, 4, 0)
    written = open_flight(tmp_path / "out")
    assert (written.camera.fx_px, written.camera.cx_px, written.camera.cy_px) == (60, 32, 24)
    telemetry = written.views[0].telemetry
    assert telemetry.time_ns == MIDDLE  # of the stamp, not of the recording
    assert telemetry.yaw_deg == pytest.approx(355) and telemetry.agl_m == 85
    assert (telemetry.pitch_deg, telemetry.roll_deg) == pytest.approx((0, 0), abs=1e-6)
    east, north = telemetry.vel_en_mps
    heading = math.radians(355)
    assert (east, north) == pytest.approx((5 * math.sin(heading), 5 * math.cos(heading)))
    for view, step in zip(written.views, (5, 15, 25, 35), strict=True):
        assert np.array_equal(view.grey(), picture(step))
    assert read_truth(tmp_path / "out/truth.csv")["000001.png"] == (46.5015, 2.5)


def test_compressed_images_are_copied(tmp_path, messages, topics):
    greys = [picture(seed) for seed in range(4)]
    stamped = [START_S * 10**9 + step * 10**9 for step in range(4)]
    suffixes = (".jpg", ".png", ".jpg", ".tif")
    del topics["/cam/image_raw"]
    topics["/cam/image_raw/compressed"] = [
        (time_ns, messages.compressed(time_ns, grey, suffix))
        for time_ns, grey, suffix in zip(stamped, greys, suffixes, strict=True)
    ]
    recording = open_source(record(tmp_path / "flight", topics, messages))
    import_flight(recording, tmp_path / "out")
    views = open_flight(tmp_path / "out").views
    assert [view.frame[-4:] for view in views] == list(suffixes)
    assert np.array_equal(views[1].grey(), greys[1])
    for view, (_, message) in zip(views, topics["/cam/image_raw/compressed"], strict=True):
        assert view.data() == message.data.tobytes()


def bayer(rgb, order):
    """A mosaic (H, W) as the sensor with that order of colours gives it, of rgb (H, W, 3)."""
    mosaic = np.empty(rgb.shape[:2], dtype=rgb.dtype)
    for position, colour in enumerate(order):
        row, column = divmod(position, 2)
        mosaic[row::2, column::2] = rgb[row::2, column::2, "rgb".index(colour)]
    return mosaic


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer(messages, order, depth):
    """Of a red, a green and a blue field; taken in another order they would swap."""
    rgb = np.zeros((24, 36, 3), dtype=np.uint8)
    for index in range(3):
        rgb[:, 12 * index : 12 * index + 12, index] = 200
    expected = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    mosaic = bayer(rgb, order)
    data = mosaic if depth == 8 else mosaic.astype(np.uint16) * 256
    grey = grey_of_image(messages.image(0, data, f"bayer_{order}{depth}"), "x")
    for index in range(3):
        inner = np.s_[4:-4, 12 * index + 4 : 12 * index + 8]
        assert np.abs(grey[inner].astype(int) - expected[inner]).max() <= 2


def test_a_thermal_camera_of_14_bits_shows_its_ground(messages):
    image = messages.image(0, picture(1).astype("<u2") * 5 + 8000, "16UC1")
    found = grey_of_image(image, "x").ravel()
    assert np.ptp(found) == 255 and np.corrcoef(found, picture(1).ravel())[0, 1] > 0.999


COLOURS = np.stack([picture(1), picture(2), picture(3)], axis=-1)
GREY = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY)
FULL = np.full((48, 64, 1), 255, np.uint8)


@pytest.mark.parametrize(
    "encoding, data, more, expected",
    [
        ("mono8", picture(1), {}, picture(1)),
        ("mono8", np.pad(picture(1), ((0, 0), (0, 16))), {"width": 64}, picture(1)),
        ("8UC1", picture(1), {}, picture(1)),
        ("rgb8", COLOURS, {}, GREY),
        ("bgr8", COLOURS[..., ::-1], {}, GREY),
        ("rgba8", np.concatenate([COLOURS, FULL], axis=-1), {}, GREY),
        ("bgra8", np.concatenate([COLOURS[..., ::-1], FULL], axis=-1), {}, GREY),
        ("mono16", picture(1).astype("<u2") * 256 + 99, {}, picture(1)),
        ("mono16", (picture(1).astype("<u2") * 256).astype(">u2"), {"is_bigendian": 1}, picture(1)),
    ],
)
def test_encodings(messages, encoding, data, more, expected):
    message = messages.image(0, np.ascontiguousarray(data), encoding, **more)
    assert np.array_equal(grey_of_image(message, "x"), expected)


@pytest.mark.parametrize(
    "changes, error",
    [
        ({"encoding": "yuv422"}, "'yuv422' is not supported"),
        ({"data": np.zeros(10, np.uint8)}, "cut short"),
        ({"step": 3}, "cut short"),
        ({"height": 0}, "has no size"),
    ],
)
def test_images_that_cannot_be_read(messages, changes, error):
    with pytest.raises(FlightError, match=error):
        grey_of_image(messages.image(0, picture(), **changes), "x")


def test_cameras(messages):
    plumb = camera_of_info(messages.camera_info(lens=(-0.2, 0.1, 0.001, -0.001, 0.05)))
    assert plumb.model == "brown" and plumb.distortion == (-0.2, 0.1, 0.001, -0.001, 0.05)
    rational = messages.camera_info("rational_polynomial", (-0.2, 0.1, 0, 0, 0.05, 0, 0, 0))
    assert camera_of_info(rational).distortion == (-0.2, 0.1, 0, 0, 0.05)
    fish = camera_of_info(messages.camera_info("equidistant", (0.1, 0.01, 0, 0)))
    assert fish.model == "fisheye" and (fish.cx_px, fish.cy_px) == (32, 24)


@pytest.mark.parametrize(
    "model, lens, changes, error",
    [
        ("thin_prism", (), {}, "not supported"),
        ("plumb_bob", (), {"k": np.zeros(9)}, "not calibrated: no matrix K"),
        ("plumb_bob", (), {"binning_x": 2}, "binning"),
    ],
)
def test_cameras_that_we_do_not_have(messages, model, lens, changes, error):
    with pytest.raises(CameraError, match=error):
        camera_of_info(messages.camera_info(model, lens, **changes))


def test_a_raw_imu_is_passed_over(tmp_path, messages, topics):
    zero = messages.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
    topics["/imu/data"] = [
        (time_ns, messages.imu(time_ns, zero, known=index % 2 == 0))
        for index, (time_ns, _) in enumerate(topics["/imu/data"])
    ]
    view = next(open_source(record(tmp_path / "flight", topics, messages)).views)
    assert view.telemetry.yaw_deg == pytest.approx(355)  # of the odometry


def test_the_horizon_is_as_good_as_an_imu_states(tmp_path, messages, topics):
    """Or as good as an autopilot's that GNSS aids, or not."""
    before = topics["/imu/data"]

    def horizon_deg(name, std_deg):
        topics["/imu/data"] = [
            (t, messages.imu(t, message.orientation, std_deg=std_deg)) for t, message in before
        ]
        views = list(open_source(record(tmp_path / name, topics, messages)).views)
        assert {view.telemetry.mount_std_deg for view in views} == {2.5}
        return [round(view.telemetry.horizon_std_deg, 6) for view in views]

    assert set(horizon_deg("stated", 0.5)) == {0.5}
    assert set(horizon_deg("placeholder", 57.3)) == {1.0}
    del topics["/fix"]
    assert set(horizon_deg("without", 0.0)) == {3.0}


def named(messages, frame, what):
    """The same message in a frame of that name."""
    what.header.frame_id = frame
    return what


def test_an_orientation_that_never_changes_is_none(tmp_path, messages, topics):
    """Lidars send 0 0 0 1, or where they are mounted, with the most messages."""
    recorded = topics["/imu/data"]
    for name, turn in ("/livox/imu", messages.turn(0)), ("/mounted/imu", messages.turn(30)):
        topics[name] = [(t + i, messages.imu(t, turn)) for t, _ in recorded for i in (0, 9)]
    path = record(tmp_path / "flight", topics, messages)
    recording = open_source(path)
    assert [view.telemetry.yaw_deg for view in recording.views] == pytest.approx([355, 5, 15, 25])
    assert recording.choices == (
        "attitude: using /imu/data, not /livox/imu (no valid message), /mounted/imu (its "
        "orientation never changes), /odom: first that fits; --topic attitude=NAME selects another",
    )
    named = open_source(path, SourceOptions(topics={"attitude": "/mounted/imu"}))
    assert next(named.views).telemetry.yaw_deg == pytest.approx(60)


def test_frames_that_are_not_of_the_body(tmp_path, messages, topics):
    topics["/imu/data"] = [
        (t, named(messages, "imu_link_ned", one)) for t, one in topics["/imu/data"]
    ]
    for _, odometry in topics["/odom"]:
        odometry.child_frame_id = "camera_pose_frame"
    recording = open_source(record(tmp_path / "flight", topics, messages))
    assert "no topic has the attitude of the aircraft" in recording.warnings
    assert (
        "none fits of /imu/data ('ned' in its name), /odom ('camera' in its name)"
        in recording.choices[0]
    )
    assert next(recording.views).telemetry.vel_en_mps is None


def test_the_receiver_that_has_a_fix(tmp_path, messages, topics):
    """And never orthonav's own fixes, which would be their own truth."""
    fixes = topics.pop("/fix")
    topics["/a/fix"] = [(t, messages.fix(t, 1.0, 1.0, status=-1)) for t, _ in fixes]
    topics["/b/fix"] = fixes
    topics["/orthonav/fix"] = [(t, messages.fix(t, 2.0, 2.0)) for t, _ in fixes]
    # Odometry whose velocity is not in the frame of the body.
    topics["/mavros/global_position/local"] = topics.pop("/odom")
    recording = open_source(record(tmp_path / "flight", topics, messages))
    assert "position: using /b/fix, not /a/fix (no valid message): first" in recording.choices[-1]
    view = next(recording.views)
    assert view.truth_latlon_deg == pytest.approx((46.5005, 2.5))
    assert view.telemetry.vel_en_mps is None


def test_ranges_that_are_no_heights(tmp_path, messages, topics):
    """Ahead by the name of the topic or frame; at the limits, or infinite, of the sensor, beyond
    which heights above take-off count."""
    down = topics.pop("/range")
    topics["/a_front"] = [(t, messages.range(t, 3.0)) for t, _ in down]
    topics["/a"] = [(t, named(messages, "sonar_left", messages.range(t, 3.0))) for t, _ in down]
    topics["/b"] = [(t, messages.range(t, (120.0, math.inf)[t % 2])) for t, _ in down]
    topics["/rel_alt"] = [(t, messages.number(200.0)) for t, _ in down]
    topics["/down"] = [
        (t, one if n < 20 else messages.range(t, 120.0)) for n, (t, one) in enumerate(down)
    ]
    recording = open_source(record(tmp_path / "flight", topics, messages))
    assert [view.telemetry.agl_m for view in recording.views] == [85, 95, 200, 200]
    assert recording.choices[1].startswith(
        "height: using /down, not /a ('left' in its name), /a_front ('front' in its name), /b (no "
    )


def test_rectified_images_have_the_camera_p(tmp_path, messages, topics):
    matrix = np.array([50.0, 0, 30.5, 0, 0, 50.0, 22.5, 0, 0, 0, 1, 0])
    info = messages.camera_info(lens=(-0.2, 0.1, 0.0, 0.0, 0.0), p=matrix)
    topics |= {"/cam/camera_info": [(START_S * 10**9, info)]}
    raw = open_source(record(tmp_path / "raw", topics, messages)).camera
    topics["/cam/image_rect/compressed"] = [
        (t, messages.compressed(t, picture())) for t, _ in topics.pop("/cam/image_raw")
    ]
    camera = open_source(record(tmp_path / "rectified", topics, messages)).camera
    assert (raw.fx_px, raw.cx_px, raw.distortion[0]) == (60, 32, -0.2)
    assert (camera.fx_px, camera.cx_px, camera.cy_px, camera.distortion) == (50, 31, 23, ())


def test_the_camera_info_of_the_nearest_namespace(tmp_path, messages, topics):
    other = messages.camera_info(k=np.array([90.0, 0, 31.5, 0, 90.0, 23.5, 0, 0, 1]))
    topics["/camera_info"] = [(t, other) for t, _ in topics["/imu/data"]]
    assert open_source(record(tmp_path / "flight", topics, messages)).camera.fx_px == 60


def test_heights_of_mavros(tmp_path, messages, topics):
    del topics["/range"]
    times = [time_ns for time_ns, _ in topics["/imu/data"]]
    topics["/mavros/altitude"] = [
        (t, messages.altitude(t, 110.0, (math.nan, -1.0)[i // 10] if i < 20 else 90.0))
        for i, t in enumerate(times)
    ]
    views = list(open_source(record(tmp_path / "a", topics, messages)).views)
    assert [view.telemetry.agl_m for view in views] == [110, 110, 90, 90]
    del topics["/mavros/altitude"]
    topics["/mavros/global_position/rel_alt"] = [(t, messages.number(105.0)) for t in times]
    topics["/battery"] = [(t, messages.number(12.5)) for t in times]
    views = list(open_source(record(tmp_path / "b", topics, messages)).views)
    assert views[0].telemetry.agl_m == 105


def test_topics_as_requested(tmp_path, messages, topics):
    topics["/other/image_raw"] = [(START_S * 10**9, messages.image(START_S * 10**9, picture(9)))]
    path = record(tmp_path / "flight", topics, messages)
    with pytest.raises(FlightError, match=r"found /cam/image_raw, /other/image_raw; give --topic"):
        open_source(path)
    telemetry = SourceOptions(topics={"image": "/cam/image_raw", "attitude": "/odom"})
    recording = open_source(path, telemetry)
    assert "attitude /odom" in recording.note and len(list(recording.views)) == 4
    for role, name, error in (
        ("image", "/none", "no /none for image; available: /cam/image_raw, /other/image_raw: "),
        ("position", "/imu/data", "no /imu/data for position; available: /fix: "),
    ):
        with pytest.raises(FlightError, match=error):
            open_source(path, SourceOptions(topics=telemetry.topics | {role: name}))


def test_without_attitude_and_fix_nothing_is_made_up(tmp_path, messages, topics):
    del topics["/imu/data"], topics["/odom"]
    topics["/fix"] = [(t, messages.fix(t, status=-1)) for t, _ in topics["/fix"]]
    recording = open_source(record(tmp_path / "flight", topics, messages))
    assert recording.warnings == ("no topic has the attitude of the aircraft",)
    view = next(recording.views)
    assert view.telemetry.missing() == ["yaw_deg", "pitch_deg", "roll_deg"]
    assert view.telemetry.vel_en_mps is None and view.truth_latlon_deg is None


@pytest.mark.parametrize("form", FORMATS)
def test_one_broken_message_does_not_end_it(tmp_path, form):
    messages = Messages(ros1=form == "bag")
    topics = flight(messages)
    images = topics["/cam/image_raw"]
    images[1] = (images[1][0], b"\0\1\0\0broken")
    odd = messages.image(images[2][0], picture(), encoding="strange")
    images[2] = (images[2][0], odd)
    topics["/imu/data"][3] = (topics["/imu/data"][3][0], b"\0\1\0\0broken")
    recording = open_source(record(tmp_path / "flight", topics, messages, form))
    done = import_flight(recording, tmp_path / "out")
    assert (done.views, done.broken) == (2, 2) and "image 1 of" in done.first_broken
    assert [view.frame for view in open_flight(tmp_path / "out").views] == [
        "000000.png",
        "000003.png",
    ]


def test_a_camera_file_and_a_log_may_stand_in(tmp_path, messages, topics):
    kept = {"/cam/image_raw": topics["/cam/image_raw"]}
    path = record(tmp_path / "flight", kept, messages)
    with pytest.raises(CameraError, match="no camera_info"):
        open_source(path)
    log = ulog(tmp_path / "a.ulg", px4_topics())
    camera = camera_file(tmp_path / "camera.json", width_px=128, height_px=96, cx_px=64, cy_px=48)
    recording = open_source(path, SourceOptions(camera=camera, telemetry=log))
    assert recording.camera.width_px == 64
    telemetry = next(recording.views).telemetry
    assert telemetry.missing() == [] and telemetry.yaw_deg == pytest.approx(352)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("how", ["cut", "noise", "header"])
def test_a_damaged_recording_is_one_error(tmp_path, form, how, capfd):
    messages = Messages(ros1=form == "bag")
    if (form, how) == ("mcap", "cut"):
        pytest.skip("read as far as it goes")
    path = record(tmp_path / "flight", flight(messages), messages, form)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    data = file.read_bytes()
    noise = np.random.default_rng(0).bytes(len(data) - 16)
    file.write_bytes(
        {"cut": data[: len(data) // 2], "noise": data[:16] + noise, "header": data[:16]}[how]
    )
    with pytest.raises(FlightError) as caught:
        import_flight(open_source(path), tmp_path / "out")
    telemetry = str(caught.value)
    assert "\n" not in telemetry and str(path) in telemetry and len(telemetry) < 600
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_recording_that_was_cut_short_is_read_as_far_as_it_goes(tmp_path, compression):
    messages = Messages()
    path = record(tmp_path / "flight", flight(messages, seconds=20), messages)
    file = next(path.glob("*.mcap"))
    rewritten(file, compression)
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    recording = open_source(path)
    assert len(recording.warnings) == 1 and "cut short" in recording.warnings[0]
    views = list(recording.views)
    assert 1 <= len(views) < 20 and np.array_equal(views[0].grey(), picture(5))
    assert "cut short" in open_source(file).warnings[0]
    file.write_bytes(data[:300])
    with pytest.raises(FlightError, match=r"cut short.* recording holds no whole message"):
        open_source(file)


def rewritten(path, compression):
    """The same messages by the writer of MCAP."""
    read = make_reader(BytesIO(path.read_bytes()))
    with path.open("wb") as stream:
        kind = getattr(CompressionType, compression.upper())
        writer = McapWriter(stream, chunk_size=4000, compression=kind)
        writer.start("ros2", "orthonav")
        known = {}
        for schema, channel, message in read.iter_messages():
            if channel.topic not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(
                known[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()


@pytest.mark.parametrize("form", ["db3", "mcap"])
@pytest.mark.parametrize("how", ["none", "empty", "no storage", "other storage", "renamed"])
def test_a_bag_whose_metadata_does_not_fit_is_read_by_its_files(tmp_path, form, how):
    messages = Messages()
    path = record(tmp_path / "flight", flight(messages), messages, form)
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    lines = [line for line in text.splitlines() if "storage_identifier" not in line]
    metadata.write_text(
        {
            "empty": "",
            "no storage": "\n".join(lines),
            "other storage": text.replace("identifier: ", "identifier: my_own_"),
        }.get(how, text)
    )
    if how == "none":
        metadata.unlink()
    if how == "renamed":
        file = next(path.glob(f"*.{form}"))
        file.rename(file.with_name(f"other_0.{form}"))
    recording = open_source(path)
    assert len(list(recording.views)) == 4
    assert [each[:25] for each in recording.warnings] == ["metadata.yaml is not used"] * (
        how != "none"
    )
    assert "report" not in "".join(recording.warnings)


def test_several_recordings_in_a_folder_are_not_one(tmp_path, messages, topics):
    path = record(tmp_path / "flight", topics, messages)
    file = next(path.glob("*.mcap"))
    (path / "metadata.yaml").unlink()
    file.rename(path / "a.mcap")
    (path / "b.mcap").write_bytes((path / "a.mcap").read_bytes())
    with pytest.raises(FlightError, match=r"2 ROS 2 recordings \(a.mcap, b.mcap\)"):
        open_source(path)


def test_a_database_that_was_cut_short_names_the_tool(tmp_path, messages, topics):
    path = record(tmp_path / "flight", topics, messages, "db3")
    file = next(path.glob("*.db3"))
    file.write_bytes(file.read_bytes()[:-30_000])
    with pytest.raises(FlightError, match=r"sqlite3 BAG.db3 \.recover"):
        open_source(path)


def test_pictures_are_not_held(tmp_path, messages):
    """Peak memory is that of a few pictures, not of all 60 (18 MB)."""
    image = picture(0, 640, 480)
    stamps = [START_S * 10**9 + step * 10**8 for step in range(60)]
    topics = {
        "/cam/image_raw": [(t, messages.image(t, image)) for t in stamps],
        "/cam/camera_info": [(stamps[0], messages.camera_info())],
    }
    path = record(tmp_path / "flight", topics, messages)
    del topics
    recording = open_source(path)
    tracemalloc.start()
    try:
        assert sum(view.grey().shape == (480, 640) for view in recording.views) == 60
        assert tracemalloc.get_traced_memory()[1] < 20 * image.nbytes
    finally:
        tracemalloc.stop()


EVENT = """service_msgs/ServiceEventInfo info
example/srv/Add_Request[<=1] request
{line}
MSG: service_msgs/ServiceEventInfo
uint8 event_type
{line}
MSG: example/srv/Add_Request
int64 a
"""


@pytest.mark.parametrize(
    "kind, definition",
    [
        ("example/srv/Add_Event", EVENT.format(line="=" * 80)),
        ("example/msg/Unreadable", "no definition {"),
    ],
)
def test_topics_that_cannot_be_parsed_are_passed_over(tmp_path, messages, kind, definition):
    """Events of services, for example: their types are no messages."""
    path, image = tmp_path / "flight", messages.image(START_S * 10**9, picture())
    with Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        event = writer.add_connection(
            "/add/_service_event",
            kind,
            msgdef=definition,
            rihs01=f"RIHS01_{0:064}",
        )
        writer.write(event, START_S * 10**9, b"\0\1\0\0")
        for topic, message in (
            ("/cam/image_raw", image),
            ("/cam/camera_info", messages.camera_info()),
        ):
            made = writer.add_connection(topic, message.__msgtype__, typestore=messages.store)
            raw = messages.store.serialize_cdr(message, message.__msgtype__)
            writer.write(made, START_S * 10**9, raw)
    (view,) = open_source(path).views
    assert view.grey().shape == picture().shape


BOMBS = {
    "zstd": zeros(512 * MB, zstandard.ZstdCompressor().compressobj(size=512 * MB)),
    "zstd without a stated size": zeros(512 * MB, zstandard.ZstdCompressor().compressobj()),
    "lz4": (frame := lz4.frame.LZ4FrameCompressor()).begin() + zeros(512 * MB, frame),
}


def unindexed(path, data, claimed, kind):
    """An MCAP of one chunk, without an index."""
    end = line(15, bytes(4)) + line(2, bytes(20)) + MAGIC
    path.write_bytes(header(b"ros2") + chunk(data, claimed, kind) + end)
    return path


@pytest.mark.parametrize("how", BOMBS)
@pytest.mark.parametrize("claimed", [100, 512 * MB, 2**62])
def test_chunks_of_mcap(tmp_path, how, claimed):
    path = unindexed(tmp_path / "a.mcap", BOMBS[how], claimed, how.split()[0].encode())
    tracemalloc.start()
    try:
        with pytest.raises(FlightError, match=r"more than|mismatch") as caught:
            open_source(path)
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


def test_chunks_of_ros_1(monkeypatch):
    bound_inflation()
    from rosbags.rosbag1 import reader

    monkeypatch.setattr(ros, "MAX_CHUNK_BYTES", MB)
    for name, pack in (("bz2", bz2.compress), ("lz4", lz4.frame.compress)):
        assert reader.decompressors[name](pack(bytes(MB))) == bytes(MB)
        for bad, words in (
            (pack(bytes(MB + 1)), "than the 1048576"),
            (pack(b"a")[:-4], "cut"),
        ):
            with pytest.raises(ValueError, match=words):
                reader.decompressors[name](bad)


def test_a_recording_whose_chunks_are_too_large(tmp_path, monkeypatch):
    messages = Messages()
    path = record(tmp_path / "flight", flight(messages), messages, "file")
    assert import_flight(open_source(path), tmp_path / "out").views == 4
    monkeypatch.setattr(ros, "MAX_HELD_BYTES", 1000)
    with pytest.raises(FlightError, match=r"more than 1000\): .*mcap"):
        open_source(path)
