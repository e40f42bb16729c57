"""Messages of ROS 2 as a second reader of their definitions writes them: by hand, for the encoder
of Cyclone DDS. Nothing here is shared with the program, which has both from `rosbags`.

Copied member by member from the .msg files of Jazzy (https://docs.ros.org/en/jazzy/p/).
"""

import dataclasses

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import (
    array,
    byte,
    float32,
    float64,
    int8,
    int32,
    sequence,
    uint8,
    uint16,
    uint32,
)


def name(package, message):
    return f"{package}.msg.dds_.{message}_"


def struct(package, message, /, **members):
    return make_idl_struct(message, name(package, message), members)


Time = struct("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = struct("std_msgs", "Header", stamp=Time, frame_id=str)
Image = struct(
    "sensor_msgs",
    "Image",
    header=Header,
    height=uint32,
    width=uint32,
    encoding=str,
    is_bigendian=uint8,
    step=uint32,
    data=sequence[uint8],
)
CompressedImage = struct(
    "sensor_msgs", "CompressedImage", header=Header, format=str, data=sequence[uint8]
)
RegionOfInterest = struct(
    "sensor_msgs",
    "RegionOfInterest",
    x_offset=uint32,
    y_offset=uint32,
    height=uint32,
    width=uint32,
    do_rectify=bool,
)
CameraInfo = struct(
    "sensor_msgs",
    "CameraInfo",
    header=Header,
    height=uint32,
    width=uint32,
    distortion_model=str,
    d=sequence[float64],
    k=array[float64, 9],
    r=array[float64, 9],
    p=array[float64, 12],
    binning_x=uint32,
    binning_y=uint32,
    roi=RegionOfInterest,
)
Quaternion = struct("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Vector3 = struct("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Imu = struct(
    "sensor_msgs",
    "Imu",
    header=Header,
    orientation=Quaternion,
    orientation_covariance=array[float64, 9],
    angular_velocity=Vector3,
    angular_velocity_covariance=array[float64, 9],
    linear_acceleration=Vector3,
    linear_acceleration_covariance=array[float64, 9],
)
Range = struct(
    "sensor_msgs",
    "Range",
    header=Header,
    radiation_type=uint8,
    field_of_view=float32,
    min_range=float32,
    max_range=float32,
    range=float32,
    variance=float32,
)
Float64 = struct("std_msgs", "Float64", data=float64)
NavSatStatus = struct("sensor_msgs", "NavSatStatus", status=int8, service=uint16)
NavSatFix = struct(
    "sensor_msgs",
    "NavSatFix",
    header=Header,
    status=NavSatStatus,
    latitude=float64,
    longitude=float64,
    altitude=float64,
    position_covariance=array[float64, 9],
    position_covariance_type=uint8,
)
Clock = struct("rosgraph_msgs", "Clock", clock=Time)
Point = struct("geometry_msgs", "Point", x=float64, y=float64, z=float64)
Pose = struct("geometry_msgs", "Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = struct(
    "geometry_msgs", "PoseWithCovariance", pose=Pose, covariance=array[float64, 36]
)
PoseWithCovarianceStamped = struct(
    "geometry_msgs", "PoseWithCovarianceStamped", header=Header, pose=PoseWithCovariance
)
GeoPoint = struct(
    "geographic_msgs", "GeoPoint", latitude=float64, longitude=float64, altitude=float64
)
GeoPointStamped = struct("geographic_msgs", "GeoPointStamped", header=Header, position=GeoPoint)
KeyValue = struct("diagnostic_msgs", "KeyValue", key=str, value=str)
DiagnosticStatus = struct(
    "diagnostic_msgs",
    "DiagnosticStatus",
    level=byte,
    name=str,
    message=str,
    hardware_id=str,
    values=sequence[KeyValue],
)
DiagnosticArray = struct(
    "diagnostic_msgs", "DiagnosticArray", header=Header, status=sequence[DiagnosticStatus]
)


def zeros(kind):
    """A message of a type with nothing in it."""
    values = {}
    for each in dataclasses.fields(kind):
        hint = each.type if not isinstance(each.type, str) else None
        values[each.name] = _zero(hint)
    return kind(**values)


def _zero(hint):
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return zeros(hint)
    if hint is str:
        return ""
    if hint is bool:
        return False
    inner = getattr(hint, "__metadata__", None)
    if inner and type(inner[0]).__name__ == "array":
        return [_zero(inner[0].subtype)] * inner[0].length
    if inner and type(inner[0]).__name__ == "sequence":
        return []
    return 0


def native(message, kind):
    """The same message in the type `kind` of this module, of a message of `rosbags`."""
    values = {}
    for each in dataclasses.fields(kind):
        value = getattr(message, each.name)
        if isinstance(each.type, type) and dataclasses.is_dataclass(each.type):
            value = native(value, each.type)
        elif hasattr(value, "tolist"):
            value = value.tolist()
        values[each.name] = value
    return kind(**values)
