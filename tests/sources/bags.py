"""Recordings of ROS messages by the writers of `rosbags`."""

import cv2
import numpy as np
from recorders import HEIGHT, START_S, WIDTH, picture
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

ALTITUDE = """std_msgs/Header header
float32 monotonic
float32 amsl
float32 local
float32 relative
float32 terrain
float32 bottom_clearance
"""
FORMATS = ("bag", "db3", "mcap")


class Messages:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, ros1=False):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg(ALTITUDE, "mavros_msgs/msg/Altitude"))

    def new(self, name, **fields):
        return self.store.types[name](**fields)

    def header(self, time_ns, frame="camera"):
        sec, nanosec = divmod(time_ns, 10**9)
        stamp = self.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        more = {"seq": 0} if self.ros1 else {}
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def vector(self, x=0.0, y=0.0, z=0.0):
        return self.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def turn(self, yaw, pitch=0.0, roll=0.0):
        """A quaternion as ROS counts: ENU from forward-left-up, Z-Y-X in degrees."""
        x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_quat()
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def image(self, time_ns, pixels, encoding="mono8", **changes):
        rows, columns = pixels.shape[:2]
        step = pixels[0].nbytes
        fields = {
            "header": self.header(time_ns),
            "height": rows,
            "width": columns,
            "encoding": encoding,
            "is_bigendian": 0,
            "step": step,
            "data": np.frombuffer(pixels.tobytes(), dtype=np.uint8),
        }
        return self.new("sensor_msgs/msg/Image", **(fields | changes))

    def compressed(self, time_ns, grey, suffix=".jpg"):
        data = cv2.imencode(suffix, grey)[1].ravel()
        return self.new(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time_ns),
            format=suffix[1:],
            data=data,
        )

    def camera_info(self, model="plumb_bob", lens=(0.0,) * 5, **changes):
        roi = self.new(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        matrices = {
            "k": np.array([60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]),
            "r": np.eye(3).ravel(),
            "p": np.zeros(12),
            "d": np.array(lens),
        }
        if self.ros1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        fields = {
            "header": self.header(START_S * 10**9),
            "height": HEIGHT,
            "width": WIDTH,
            "distortion_model": model,
            **matrices,
            "binning_x": 0,
            "binning_y": 0,
            "roi": roi,
        }
        return self.new("sensor_msgs/msg/CameraInfo", **(fields | changes))

    def imu(self, time_ns, turn, known=True):
        nine = np.zeros(9)
        nine[0] = 0.0 if known else -1.0
        return self.new(
            "sensor_msgs/msg/Imu",
            header=self.header(time_ns, "base_link"),
            orientation=turn,
            orientation_covariance=nine,
            angular_velocity=self.vector(),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(),
            linear_acceleration_covariance=np.zeros(9),
        )

    def odometry(self, time_ns, turn, forward=5.0, left=0.0):
        pose = self.new(
            "geometry_msgs/msg/Pose",
            position=self.new("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
            orientation=turn,
        )
        twist = self.new(
            "geometry_msgs/msg/Twist", linear=self.vector(forward, left), angular=self.vector()
        )
        return self.new(
            "nav_msgs/msg/Odometry",
            header=self.header(time_ns, "odom"),
            child_frame_id="base_link",
            pose=self.new(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)
            ),
            twist=self.new(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
            ),
        )

    def fix(self, time_ns, lat=46.5, lon=2.5, alt=400.0, status=0):
        return self.new(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(time_ns, "gps"),
            status=self.new("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=lat,
            longitude=lon,
            altitude=alt,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )

    def range(self, time_ns, metres):
        more = {} if self.ros1 or "variance" not in self._fields("Range") else {"variance": 0.0}
        return self.new(
            "sensor_msgs/msg/Range",
            header=self.header(time_ns),
            radiation_type=1,
            field_of_view=0.1,
            min_range=0.2,
            max_range=120.0,
            range=metres,
            **more,
        )

    def _fields(self, name):
        return self.store.types[f"sensor_msgs/msg/{name}"].__dataclass_fields__

    def altitude(self, time_ns, relative, clearance):
        return self.new(
            "mavros_msgs/msg/Altitude",
            header=self.header(time_ns),
            monotonic=0.0,
            amsl=400.0,
            local=0.0,
            relative=relative,
            terrain=0.0,
            bottom_clearance=clearance,
        )

    def number(self, value):
        return self.new("std_msgs/msg/Float64", data=value)


def flight(messages, seconds=4, rate_hz=10):
    """Topics of a flight with heading 350 to 30, that is 100 to 60 as ROS counts."""
    topics = {name: [] for name in ("/cam/image_raw", "/imu/data", "/odom", "/fix", "/range")}
    topics["/cam/camera_info"] = [(START_S * 10**9, messages.camera_info())]
    for step in range(seconds * rate_hz + 1):
        time_ns = START_S * 10**9 + step * 10**9 // rate_hz
        turn = messages.turn(100 - step)
        late_ns = time_ns + 30_000_000  # recorded later than stamped
        topics["/imu/data"].append((late_ns, messages.imu(time_ns, turn)))
        topics["/odom"].append((late_ns, messages.odometry(time_ns, turn)))
        topics["/fix"].append((late_ns, messages.fix(time_ns, lat=46.5 + step / 1e4)))
        topics["/range"].append((late_ns, messages.range(time_ns, 80.0 + step)))
        if step % rate_hz == 5:
            image = messages.image(time_ns, picture(step))
            topics["/cam/image_raw"].append((late_ns, image))
    return topics


def record(path, topics, messages, form="mcap"):
    """Write messages by topic, (time_ns, message) each; raw bytes may stand for a message.

    Gives the path to open: a .bag, a folder with metadata.yaml, or, of "file", an .mcap in it.
    """
    store = messages.store
    if form == "bag":
        writer = Writer1(path.with_suffix(".bag"))
    else:
        plugin = StoragePlugin.SQLITE3 if form == "db3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        lines = []
        for topic, timed in topics.items():
            first = next(message for _, message in timed if not isinstance(message, bytes))
            kind = first.__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            lines += [(time_ns, connection, message) for time_ns, message in timed]
        for time_ns, connection, message in sorted(lines, key=lambda line: line[0]):
            if isinstance(message, bytes):
                raw = message
            elif form == "bag":
                raw = store.serialize_ros1(message, connection.msgtype)
            else:
                raw = store.serialize_cdr(message, connection.msgtype)
            writer.write(connection, time_ns, raw)
    if form == "bag":
        return path.with_suffix(".bag")
    return next(path.glob("*.mcap")) if form == "file" else path
