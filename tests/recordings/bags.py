"""Recordings of ROS messages by the writers of `rosbags`."""

import math

import cv2
import numpy as np
from recorders import HEIGHT, START_S, WIDTH, picture
from rosbags.interfaces import Nodetype
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

    def __init__(self, ros1=False, store=Stores.ROS2_HUMBLE):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else store)
        self.store.register(get_types_from_msg(ALTITUDE, "mavros_msgs/msg/Altitude"))

    def new(self, name, **fields):
        """A message of that type; fields that are not given are zero or empty."""
        values = {field: self._zero(*kind) for field, kind in self.store.fielddefs[name][1]}
        return self.store.types[name](**values | fields)

    def _zero(self, node, what):
        if node == Nodetype.NAME:
            return self.new(what)
        if node == Nodetype.BASE:
            return {"string": "", "bool": False}.get(what[0], 0)
        return np.zeros(what[1] if node == Nodetype.ARRAY else 0, dtype=np.float64)

    def header(self, time_ns):
        sec, nanosec = divmod(time_ns, 10**9)
        stamp = self.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.new("std_msgs/msg/Header", stamp=stamp)

    def turn(self, yaw, pitch=0.0, roll=0.0):
        """A quaternion as ROS counts: ENU from forward-left-up, Z-Y-X in degrees."""
        x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_quat()
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def stamped(self, name, time_ns, **fields):
        return self.new(name, **{"header": self.header(time_ns)} | fields)

    def image(self, time_ns, pixels, encoding="mono8", **changes):
        rows, columns = pixels.shape[:2]
        data = np.frombuffer(pixels.tobytes(), dtype=np.uint8)
        fields = {"height": rows, "width": columns, "encoding": encoding, "data": data}
        fields |= {"step": pixels[0].nbytes, **changes}
        return self.stamped("sensor_msgs/msg/Image", time_ns, **fields)

    def compressed(self, time_ns, grey, suffix=".jpg"):
        fields = {"format": suffix[1:], "data": cv2.imencode(suffix, grey)[1].ravel()}
        return self.stamped("sensor_msgs/msg/CompressedImage", time_ns, **fields)

    def camera_info(self, model="plumb_bob", lens=(0.0,) * 5, **changes):
        matrices = {"k": np.array([60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1]), "d": np.array(lens)}
        if self.ros1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        fields = {"height": HEIGHT, "width": WIDTH, "distortion_model": model, **matrices}
        time_ns = START_S * 10**9
        return self.stamped("sensor_msgs/msg/CameraInfo", time_ns, **fields | changes)

    def imu(self, time_ns, turn, known=True, std_deg=0.0):
        nine = np.zeros(9)
        nine[0] = math.radians(std_deg) ** 2 if known else -1.0
        fields = {"orientation": turn, "orientation_covariance": nine}
        return self.stamped("sensor_msgs/msg/Imu", time_ns, **fields)

    def odometry(self, time_ns, turn, forward=5.0, left=0.0):
        odometry = self.stamped("nav_msgs/msg/Odometry", time_ns)
        odometry.pose.pose.orientation = turn
        odometry.twist.twist.linear = self.new("geometry_msgs/msg/Vector3", x=forward, y=left)
        return odometry

    def fix(self, time_ns, lat=46.5, lon=2.5, alt=400.0, status=0):
        fields = {"latitude": lat, "longitude": lon, "altitude": alt}
        fields["status"] = self.new("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        return self.stamped("sensor_msgs/msg/NavSatFix", time_ns, **fields)

    def range(self, time_ns, metres):
        fields = {"min_range": 0.2, "max_range": 120.0, "range": metres}
        return self.stamped("sensor_msgs/msg/Range", time_ns, **fields)

    def altitude(self, time_ns, relative, clearance):
        fields = {"amsl": 400.0, "relative": relative, "bottom_clearance": clearance}
        return self.stamped("mavros_msgs/msg/Altitude", time_ns, **fields)

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
