"""Small files as the true recorders write them, by the libraries' own writers or byte by byte."""

import json
import math
import re
import struct
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

WIDTH, HEIGHT = 64, 48
START_S = 1_700_000_000  # 2023-11-14 22:13:20 UTC
CAMERA = {
    "width_px": WIDTH,
    "height_px": HEIGHT,
    "fx_px": 60.0,
    "fy_px": 60.0,
    "cx_px": 32.0,
    "cy_px": 24.0,
}
XMP = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:{prefix}="{uri}" {attributes}></rdf:Description>
</rdf:RDF></x:xmpmeta><?xpacket end="w"?>"""
SENSEFLY = "sensefly", "http://ns.sensefly.com/1.0/"
DJI = "drone-dji", "http://www.dji.com/drone-dji/1.0/"
AUTEL = "drone", "http://www.autelrobotics.com/drone/1.0/"
PIX4D = "Camera", "http://pix4d.com/camera/1.0/"


def picture(seed=0, width=WIDTH, height=HEIGHT):
    """Smooth grey levels (H, W) uint8."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def camera_file(path, **changes):
    path.write_text(json.dumps({"camera": CAMERA | changes, "note": ""}))
    return path


# Photographs.


def packet(maker=DJI, **values):
    prefix, uri = maker
    telemetry = "\n".join(f'{prefix}:{name}="{value}"' for name, value in values.items())
    return XMP.format(prefix=prefix, uri=uri, attributes=telemetry)


def dji(yaw=30.0, pitch=-90.0, roll=0.0, height=120.5, body=77.7):
    return packet(
        GimbalYawDegree=f"{yaw:+.2f}",
        GimbalPitchDegree=f"{pitch:+.2f}",
        GimbalRollDegree=f"{roll:+.2f}",
        FlightYawDegree=f"{body:+.2f}",
        FlightXSpeed="+3.50",
        FlightYSpeed="-1.25",
        RelativeAltitude=f"{height:+.2f}",
        AbsoluteAltitude="+400.00",
    )


def photo(path, time="2023:11:14 22:13:20", more=(), gps=(), xmp=None, seed=0, make="DJI", first=(),
          pixels=None, **size):  # fmt: skip
    """A JPEG, PNG or TIFF with EXIF (`more` by number of the tag, `gps` and `first`, which is the
    first directory, likewise) and XMP."""
    exif = Image.Exif()
    exif[0x010F] = make
    exif.update(dict(first))
    inner = {0x9003: time, 0x9011: "+00:00", 0xA405: 24, 0x920A: 8.8, **dict(more)}
    exif.get_ifd(0x8769).update({tag: value for tag, value in inner.items() if value is not None})
    if gps:
        exif.get_ifd(0x8825).update(dict(gps))
    options = {"exif": exif}
    if xmp is not None and path.suffix == ".png":
        options["pnginfo"] = PngInfo()
        options["pnginfo"].add_itxt("XML:com.adobe.xmp", xmp)
    elif xmp is not None and path.suffix == ".tif":
        exif[700] = xmp.encode()
    elif xmp is not None:
        options["xmp"] = xmp.encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seed, **size) if pixels is None else pixels).save(path, **options)
    return path


def maker_notes(order="<", **values):
    """Maker notes as older models of DJI write them: an IFD of floats."""
    tags = {"yaw": 7, "camera_pitch": 9, "camera_yaw": 10, "camera_roll": 11}
    entries = [struct.pack(f"{order}HHI4s", 1, 2, 4, b"DJI\0")]
    entries += [struct.pack(f"{order}HHIf", tags[name], 11, 1, values[name]) for name in values]
    return struct.pack(f"{order}H", len(entries)) + b"".join(entries) + bytes(4)


def place(lat, lon, alt=400.0):
    """GPS tags of a place."""

    def dms(angle):
        seconds = abs(angle) * 3600
        return int(seconds // 3600), int(seconds % 3600 // 60), seconds % 60

    return {
        1: "N" if lat >= 0 else "S",
        2: dms(lat),
        3: "E" if lon >= 0 else "W",
        4: dms(lon),
        5: b"\x00",
        6: alt,
    }


# Videos and their subtitles.


def video(path, frames=30, fps=10.0, code="FFV1", shown=picture):
    """A video whose frame of a number is `shown` of it."""
    kind, size = cv2.VideoWriter_fourcc(*code), shown(0).shape[::-1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, kind, fps, size)
    assert writer.isOpened()
    for number in range(frames):
        writer.write(cv2.cvtColor(shown(number), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def hidden(path, begin_s, shown_s):
    """An MP4 whose edits hide what is before and after, as cutting without encoding does."""
    data = bytearray(path.read_bytes())
    ticks, *_ = struct.unpack_from(">I", data, data.index(b"mdhd") + 16)
    edit = round(shown_s * 1000), round(begin_s * ticks)
    struct.pack_into(">II", data, data.index(b"elst") + 12, *edit)
    struct.pack_into(">I", data, data.index(b"mvhd") + 20, edit[0])
    path.write_bytes(data)
    return path


def turned(path):
    """An MP4 that players show upside down, by the matrix of its track."""
    data = bytearray(path.read_bytes())
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, -65536, 0, 0, 0, -65536, 0, 0, 0, 2**30)
    path.write_bytes(data)
    return path


def late_by_250_ms(path):
    """A Matroska file whose clock begins later."""

    def later(found):
        time_ms = int.from_bytes(found[1]) + 250
        return b"\xe7\x82" + time_ms.to_bytes(2) if len(found[1]) == 2 else b"\xe7\x81\xfa"

    data = re.sub(rb"\xe7(?:\x81(?=\0\xa3)|\x82(?=..\xa3))(..?)(?=\xa3)", later, path.read_bytes())
    at = data.index(b"\x44\x89\x88") + 3
    (length,) = struct.unpack_from(">d", data, at)
    path.write_bytes(data[:at] + struct.pack(">d", length + 250) + data[at + 8 :])
    return path


def late(path, by_s):
    """An MP4 whose first edit shows nothing."""
    data = bytearray(path.read_bytes())
    at = data.index(b"elst")
    data[at + 11] = 2
    data[at + 12 : at + 12] = struct.pack(">Iii", round(by_s * 1000), -1, 65536)
    (ticks,) = struct.unpack_from(">I", data, data.index(b"mvhd") + 20)
    struct.pack_into(">I", data, data.index(b"mvhd") + 20, ticks + round(by_s * 1000))
    for kind in (b"moov", b"trak", b"edts", b"elst"):
        (size,) = struct.unpack_from(">I", data, data.index(kind) - 4)
        struct.pack_into(">I", data, data.index(kind) - 4, size + 12)
    path.write_bytes(data)
    return path


def twice_as_wide(path):
    """A Matroska file whose pixels are twice as wide as high; taken from its empty space."""
    data = path.read_bytes()
    size = b"\x54\xb0\x81" + bytes([2 * WIDTH]) + b"\x54\xba\x81" + bytes([HEIGHT])
    data = data.replace(b"\x54\xb2\x81\x04", size + b"\x54\xb2\x81\x03")
    path.write_bytes(data.replace(b"\xec\x01" + bytes(6) + b"\2\0\0", b"\xec\x81\0", 1))
    return path


def clock(seconds):
    whole, thousandths = divmod(round(seconds * 1000), 1000)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d},{thousandths:03d}"


def subtitles(path, texts, encoding="utf-8"):
    parts = [
        f"{i + 1}\n{clock(i / 10)} --> {clock((i + 1) / 10)}\n{text}\n"
        for i, text in enumerate(texts)
    ]
    path.write_text("\n".join(parts), encoding=encoding)
    return path


def dji_subtitle(number, yaw=10.0, pitch=-90.0, lat=46.5, lon=2.5, rel_alt=120.0):
    return (
        f'<font size="28">FrameCnt: {number + 1}, DiffTime: 33ms\n'
        f"2023-11-14 22:13:20.{number:03d}\n"
        "[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [ev: 0] [color_md: default] [focal_len: 24.00] "
        f"[latitude: {lat:.6f}] [longitude: {lon:.6f}] [rel_alt: {rel_alt:.3f} abs_alt: 402.125] "
        f"[gb_yaw: {yaw:.1f} gb_pitch: {pitch:.1f} gb_roll: 0.0] </font>"
    )


# Autopilots' logs.


def flown(seconds=10, rate_hz=10):
    """Times in s and body yaw, pitch, roll in degrees of a turning, rocking flight."""
    for step in range(seconds * rate_hz + 1):
        t = step / rate_hz
        yield t, (350.0 + 4 * t) % 360, 3 * math.sin(t), 2 * math.cos(t)


def quaternion_wxyz(yaw, pitch, roll):
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_quat()
    return w, x, y, z


def ulog(path, topics):
    """A ULog by pyulog's own writer. `topics`: name, or name:instance -> (fields as its format has
    them, rows)."""
    from pyulog.core import ULog

    log = ULog(None)
    codes = ULog._UNPACK_TYPES
    for number, (topic, (text, rows)) in enumerate(topics.items()):
        name, _, instance = topic.partition(":")
        log._message_formats[name] = ULog.MessageFormat(f"{name}:{text};".encode(), None)
        flat = {}
        for part in text.split(";"):
            kind, field = part.split()
            base, _, size = kind.partition("[")
            names = [f"{field}[{i}]" for i in range(int(size[:-1]))] if size else [field]
            flat.update(dict.fromkeys(names, base))
        dtype = np.dtype([(field, codes[kind][2]) for field, kind in flat.items()])
        message = SimpleNamespace(
            multi_id=int(instance or 0),
            msg_id=number,
            message_name=name,
            field_data=[SimpleNamespace(field_name=f, type_str=k) for f, k in flat.items()],
            timestamp_idx=0,
            dtype=dtype,
            buffer=np.array(rows, dtype=dtype).tobytes(),
        )
        log._data_list.append(ULog.Data(message))
    log.write_ulog(str(path))
    return path


PLACE = "uint64_t timestamp;double lat;double lon;float alt"


def px4_topics(seconds=10, boot_us=5_000_000, sensor=True):
    """A flight as PX4 logs it."""
    attitude, local, place, gps = [], [], [], []
    for t, yaw, pitch, roll in flown(seconds):
        stamp = boot_us + round(t * 1e6)
        attitude.append((stamp, *quaternion_wxyz(yaw, pitch, roll)))
        # Without a sensor the estimator guesses a height and calls it valid.
        bottom = (90.0 + t, t < 8, 1) if sensor else (0.1, True, 0)
        local.append((stamp, 3.0, -1.0, -100.0 - t, *bottom))
        place.append((stamp, 46.5, 2.5, 400.0 + t))
        gps.append((stamp, START_S * 10**6 + round(t * 1e6), 465_000_000, 25_000_000, 400_000, 3))
    return {
        "vehicle_attitude": ("uint64_t timestamp;float[4] q", attitude),
        "vehicle_local_position": (
            "uint64_t timestamp;float vx;float vy;float z;float dist_bottom;bool dist_bottom_valid"
            ";uint8_t dist_bottom_sensor_bitfield",
            local,
        ),
        "vehicle_global_position": (PLACE, place),
        "home_position": (PLACE, [(boot_us, 46.5, 2.5, 280.0)]),
        "vehicle_gps_position": (
            "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt"
            ";uint8_t fix_type",
            gps,
        ),
    }


DATAFLASH = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "ATT": (129, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "GPS": (
        130,
        "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
    ),
    "POS": (131, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "RFND": (132, "QBCBB", "TimeUS,Instance,Dist,Stat,Orient"),
}
_STRUCT = {"B": "B", "n": "4s", "N": "16s", "Z": "64s", "Q": "Q", "c": "h", "C": "H", "I": "I"}
_STRUCT |= {"H": "H", "L": "i", "e": "i", "f": "f"}


def record(name, *values):
    number, format_, _ = DATAFLASH[name]
    packed = struct.pack("<" + "".join(_STRUCT[code] for code in format_), *values)
    return b"\xa3\x95" + bytes([number]) + packed


def rangefinder(us, t):
    """Fields of RFND: 95.5 m downward, which is valid for 5 s."""
    return us, 0, 9_550, 4 if t < 5 else 1, 25


def dataflash(path, seconds=10, boot_us=3_000_000, attitude=True, gps=True):
    """A DataFlash log with the FMT records that ArduPilot writes."""
    data = b""
    for name, (number, format_, columns) in DATAFLASH.items():
        length = 3 + struct.calcsize("<" + "".join(_STRUCT[code] for code in format_))
        texts = (text.encode() for text in (name, format_, columns))
        data += record("FMT", number, length, *texts)
    week_ms = (START_S + 18 - 315_964_800) % 604_800 * 1000
    week = (START_S + 18 - 315_964_800) // 604_800
    for t, yaw, pitch, roll in flown(seconds):
        us = boot_us + round(t * 1e6)
        if gps:
            gms = week_ms + round(t * 1000)
            fix = us, 0, 3, gms, week, 12, 80, 465_000_000, 25_000_000, 40_000
            data += record("GPS", *fix, 5.0, 90.0, 0.0, 0.0, 1)
        if attitude:
            angles = (round(100 * a) for a in (roll, roll, pitch, pitch, yaw, yaw))
            data += record("ATT", us, *angles)
        data += record("POS", us, 465_000_000, 25_000_000, 400.0, 110.0 + t, 110.0)
        data += record("RFND", *rangefinder(us, t))
    path.write_bytes(data)
    return path


def sent(sender, t, *messages, old=False):
    """Messages (name, fields ..) of a sender (system, component) as a telemetry log holds them:
    MAVLink 2, or 1, by pymavlink's packers, behind the time of receipt."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    packer = dialect.MAVLink(None, srcSystem=sender[0], srcComponent=sender[1])
    stamp = struct.pack(">Q", START_S * 10**6 + round(t * 1e6))
    packed = (getattr(dialect, f"MAVLink_{name}_message")(*of) for name, *of in messages)
    return b"".join(stamp + message.pack(packer, force_mavlink1=old) for message in packed)


def tlog(path, seconds=10, attitude=True):
    """A telemetry log of an autopilot, with the heartbeat of a ground station."""
    data, place = b"", (465_000_000, 25_000_000, 400_000)
    for t, yaw, pitch, roll in flown(seconds):
        angles = [math.radians(a) for a in (roll, pitch, yaw)]
        ms = round(t * 1000)
        data += sent((255, 190), t, ("heartbeat", 6, 8, 0, 0, 4, 3))
        if attitude:
            data += sent((1, 1), t, ("attitude", ms, *angles, 0, 0, 0))
        above = ("global_position_int", ms, *place, 105_000 + ms, -100, 300, 0, 35_000)
        data += sent((1, 1), t, above, ("gps_raw_int", ms * 1000, 3, *place, 80, 80, 500, 9000, 12))
    path.write_bytes(data)
    return path
