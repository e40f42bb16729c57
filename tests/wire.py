"""Reads MAVLink 2 frames without pymavlink.

Written from the serialization guide (mavlink.io/en/guide/serialization.html) and from the field
tables below, which were typed from the definitions; it shares nothing with the encoder.
"""

import functools
import re
import struct

SIZES = {"B": 1, "b": 1, "s": 1, "H": 2, "I": 4, "i": 4, "f": 4, "Q": 8, "q": 8}
TYPES = {
    **{"B": "uint8_t", "b": "int8_t", "H": "uint16_t", "I": "uint32_t", "i": "int32_t"},
    **{"f": "float", "Q": "uint64_t", "q": "int64_t", "s": "char"},
}
# id, name, checksum seed; fields in the order of the definition, extensions after "|"
DEFINITIONS = """
0 HEARTBEAT 50
    B:type B:autopilot B:base_mode I:custom_mode B:system_status B:mavlink_version |
48 SET_GPS_GLOBAL_ORIGIN 41
    B:target_system i:latitude i:longitude i:altitude | Q:time_usec
75 COMMAND_INT 158
    B:target_system B:target_component B:frame H:command B:current B:autocontinue
    f:param1 f:param2 f:param3 f:param4 i:x i:y f:z |
76 COMMAND_LONG 152
    B:target_system B:target_component H:command B:confirmation
    f:param1 f:param2 f:param3 f:param4 f:param5 f:param6 f:param7 |
102 VISION_POSITION_ESTIMATE 158
    Q:usec f:x f:y f:z f:roll f:pitch f:yaw | f:covariance:21 B:reset_counter
111 TIMESYNC 34
    q:tc1 q:ts1 |
232 GPS_INPUT 151
    Q:time_usec B:gps_id H:ignore_flags I:time_week_ms H:time_week B:fix_type i:lat i:lon
    f:alt f:hdop f:vdop f:vn f:ve f:vd f:speed_accuracy f:horiz_accuracy f:vert_accuracy
    B:satellites_visible | H:yaw
253 STATUSTEXT 83
    B:severity s:text:50 | H:id B:chunk_seq
296 GLOBAL_POSITION_SENSOR 158
    B:target_system B:target_component B:id Q:time_usec I:processing_time B:source B:flags
    i:lat i:lon f:alt_ellipsoid f:alt f:eph f:epv |
331 ODOMETRY 91
    Q:time_usec B:frame_id B:child_frame_id f:x f:y f:z f:q:4 f:vx f:vy f:vz f:rollspeed
    f:pitchspeed f:yawspeed f:pose_covariance:21 f:velocity_covariance:21 | B:reset_counter
    B:estimator_type b:quality
"""
TABLES = {
    int(number): (name, int(seed), fields)
    for number, name, seed, fields in re.findall(
        r"^(\d+) (\w+) (\d+)\n(.+?)(?=^\d|\Z)", DEFINITIONS, re.MULTILINE | re.DOTALL
    )
}


def of_byte(crc: int) -> int:
    """CRC-16/MCRF4XX of one byte, bit by bit."""
    for _ in range(8):
        crc = (crc >> 1) ^ 0x8408 if crc & 1 else crc >> 1
    return crc


CRC = [of_byte(byte) for byte in range(256)]


def x25(data: bytes) -> int:
    """CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ CRC[(crc ^ byte) & 0xFF]
    return crc


@functools.cache
def layout(table: str) -> tuple[list[tuple[str, str, int]], int]:
    """Fields in the order of the wire (the widest first, extensions last), how many are base."""
    base, extensions = (
        [(*part.split(":"), 0) for part in half.split()] for half in table.split("|")
    )
    base, extensions = ([(f[0], f[1], int(f[2])) for f in half] for half in (base, extensions))
    base.sort(key=lambda entry: -SIZES[entry[0]])
    return base + extensions, len(base)


@functools.cache
def checksum_seed(number: int) -> int:
    """Of a message, by its definition."""
    name, _, table = TABLES[number]
    fields, base = layout(table)
    text = f"{name} ".encode()
    for kind, field, length in fields[:base]:
        text += f"{TYPES[kind]} {field} ".encode() + (bytes([length]) if length else b"")
    crc = x25(text)
    return (crc & 0xFF) ^ (crc >> 8)


def decode(frame: bytes) -> dict:
    """All fields of one MAVLink 2 frame with its header; asserts length and checksums."""
    magic, length, incompatible, _, sequence, system, component = frame[:7]
    number = int.from_bytes(frame[7:10], "little")
    name, seed, table = TABLES[number]
    fields, _ = layout(table)
    assert magic == 0xFD and incompatible in (0, 1)
    assert len(frame) == 12 + length + 13 * incompatible
    assert checksum_seed(number) == seed
    checksum = int.from_bytes(frame[10 + length : 12 + length], "little")
    assert checksum == x25(frame[1 : 10 + length] + bytes([seed]))
    shape = "<" + "".join(f"{count or ''}{kind}" for kind, _, count in fields)
    payload = frame[10 : 10 + length].ljust(struct.calcsize(shape), b"\0")
    values = list(struct.unpack(shape, payload))
    out = {"name": name, "sequence": sequence, "from": (system, component), "signed": incompatible}
    for shape_of, field, count in fields:
        many = count and shape_of != "s"
        out[field] = tuple(values.pop(0) for _ in range(count)) if many else values.pop(0)
    return out
