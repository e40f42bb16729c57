"""The other end of the graph in a real ROS 2: a node of `rclpy`, run by the Python of its own
environment. Nothing of this program is imported here.

    python rclpy_peer.py FLIGHT.npz [--seconds S] [--enough N] [--simulated]

publishes the images of a flight with their camera_info, imu, range and a GNSS receiver that lies,
stamped with the time of now, until S seconds are over or N positions came. `--simulated`: the time
is that of a /clock that began long ago. Without a flight (`-`) it publishes a number on /rel_alt.
`odd` has endpoints that cannot match those of orthonav. It prints what it hears on the topics of
orthonav, one line of JSON each.
"""

import argparse
import array
import json
import math
import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu, NavSatFix, Range
from std_msgs.msg import Float64

IMU_HZ = 20.0
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SIMULATED_NS = 1_700_000_000 * 10**9


def say(**values):
    print(json.dumps(values), flush=True)


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Peer:
    def __init__(self):
        self.node = rclpy.create_node("peer")
        self.fixes = 0
        for topic, kind, heard, quality in (
            ("/orthonav/fix", NavSatFix, self.fix, 10),
            ("/orthonav/pose", PoseWithCovarianceStamped, self.pose, 10),
            ("/diagnostics", DiagnosticArray, self.health, 10),
            ("/rosout", Log, self.log, LATCHED),
        ):
            self.node.create_subscription(kind, topic, heard, quality)

    def fix(self, message):
        self.fixes += 1
        cov = list(message.position_covariance)
        place = message.latitude, message.longitude, message.altitude
        say(fix=place, stamp_ns=stamp_ns(message), var_m2=cov[0])

    def pose(self, message):
        where = message.pose.pose.position
        say(pose=[where.x, where.y], stamp_ns=stamp_ns(message))

    def health(self, message):
        status = message.status[0]
        values = {each.key: each.value for each in status.values}
        level = int.from_bytes(status.level, "little")
        say(level=level, message=status.message, values=values)

    def log(self, message):
        if message.name == "orthonav":
            say(log=message.msg)

    def spin(self, until_s):
        while (left_s := until_s - time.monotonic()) > 0:
            rclpy.spin_once(self.node, timeout_sec=left_s)

    def number(self, seconds):
        publisher = self.node.create_publisher(Float64, "/rel_alt", 10)
        for _ in range(round(seconds * 10)):
            publisher.publish(Float64(data=100.0))
            self.spin(time.monotonic() + 0.1)

    def odd(self, seconds):
        self.node.create_publisher(Image, "/cam/image_raw", qos_profile_sensor_data)
        self.node.create_publisher(Float64, "/range", 10)
        self.node.create_subscription(NavSatFix, "/orthonav/fix", self.fix, LATCHED)
        self.spin(time.monotonic() + seconds)

    def stamped(self, kind, time_ns):
        made = kind()
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(time_ns, 10**9)
        return made

    def fly(self, flight, seconds, enough, simulated):
        """Publish a flight, from its start again when it is over, for so long."""
        greys, yaw_rad = flight["greys"], math.radians(float(flight["yaw_enu_deg"]))
        image, info, imu, height, gnss, clock = (
            self.node.create_publisher(kind, topic, 10)
            for kind, topic in (
                (Image, "/cam/image_raw"),
                (CameraInfo, "/cam/camera_info"),
                (Imu, "/imu"),
                (Range, "/range"),
                (NavSatFix, "/gnss"),
                (Clock, "/clock"),
            )
        )
        while image.get_subscription_count() == 0:
            self.spin(time.monotonic() + 0.1)
        _, rows, columns = greys.shape
        begun_s, every_s, sent, step = time.monotonic(), float(flight["every_s"]), 0, 0
        ahead_ns = SIMULATED_NS - time.time_ns() if simulated else 0
        while time.monotonic() - begun_s < seconds and self.fixes < enough:
            now_ns = time.time_ns() + ahead_ns
            if simulated:
                clock.publish(Clock(clock=self.stamped(Imu, now_ns).header.stamp))
            turn = self.stamped(Imu, now_ns)
            turn.orientation.z, turn.orientation.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)
            imu.publish(turn)
            above = self.stamped(Range, now_ns)
            above.min_range, above.max_range, above.range = 1.0, 1000.0, float(flight["agl_m"])
            height.publish(above)
            lie = self.stamped(NavSatFix, now_ns)
            lie.latitude, lie.longitude = 10.0, 20.0
            gnss.publish(lie)
            if time.monotonic() - begun_s >= sent * every_s:
                made = self.stamped(CameraInfo, now_ns)
                made.height, made.width, made.distortion_model = rows, columns, "plumb_bob"
                made.k, made.d = list(map(float, flight["k"])), [0.0] * 5
                info.publish(made)
                seen = self.stamped(Image, now_ns)
                seen.height, seen.width, seen.step, seen.encoding = rows, columns, columns, "mono8"
                seen.data = array.array("B", greys[sent % len(greys)].tobytes())
                image.publish(seen)
                say(image=sent % len(greys), stamp_ns=now_ns)
                sent += 1
            step += 1
            self.spin(begun_s + step / IMU_HZ)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("flight")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--enough", type=int, default=10**6)
    parser.add_argument("--simulated", action="store_true")
    options = parser.parse_args()
    rclpy.init()
    peer = Peer()
    if options.flight == "-":
        peer.number(options.seconds)
    elif options.flight == "odd":
        peer.odd(options.seconds)
    else:
        peer.fly(np.load(options.flight), options.seconds, options.enough, options.simulated)
    say(nodes=peer.node.get_node_names())
    peer.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
