"""Units, signs, time bases and heights beside independent readers: ExifTool, pyulog.

Over small files made here and, where they are there, over real recordings.
"""

import json
import math
import os
import re
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog
from recorders import SENSEFLY, dji, maker_notes, packet, photo, place

from orthonav.ground.recordings import open_source
from orthonav.ground.recordings.exif import read_photo
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.photos import posed
from orthonav.ground.recordings.subtitles import read_srt

ROOT = Path(__file__).parents[2]
RECORDINGS = (
    Path(os.environ.get("ORTHONAV_DATA", ROOT.parent / "shared" / "data")).resolve() / "recordings"
)
DOWN = (0.0, 0.0, 0.0)
EXIFTOOL = shutil.which("exiftool")
needs_exiftool = pytest.mark.skipif(
    EXIFTOOL is None, reason="ExifTool is not installed (Debian: libimage-exiftool-perl)"
)


def recorded(kind, *suffixes):
    """Real recordings of a kind, or one case that is skipped."""
    found = sorted(p for p in (RECORDINGS / kind).rglob("*") if p.suffix.lower() in suffixes)
    if found:
        return [pytest.param(path, id=path.name) for path in found]
    absent = pytest.mark.skip(reason=f"optional recordings are not there: {RECORDINGS / kind}")
    return [pytest.param(None, marks=absent, id="none")]


# Photographs and ExifTool.


def made(name, folder):
    """A small photograph of this maker."""
    path, gps = folder / f"{name}.jpg", place(-33.9, -151.25, alt=412.5)
    utc = "2023:11:14 22:13:20"
    if name == "dji":
        return photo(path, gps=gps, xmp=dji(yaw=-38.6, pitch=-70.0), first={0x0110: "FC6310"})
    if name == "notes":
        notes = maker_notes(yaw=17.5, camera_pitch=-80.0, camera_yaw=-76.5, camera_roll=0.0)
        return photo(path, more={0x927C: notes}, gps=gps)
    names = {"Heading": 70.0, "PitchAngle": 2.5, "RollAngle": -3.5, "Height": 66.1}
    xmp = packet(SENSEFLY, **names, UTCTime=utc)
    return photo(path, "2023:11:14 18:12:46", {0x9011: None}, gps, xmp, make="Canon")


def tags_of(path):
    """Values by ExifTool: numbers, without printing conversions, by group and name."""
    command = [EXIFTOOL, "-j", "-n", "-a", "-G1", str(path)]
    done = subprocess.run(command, capture_output=True, check=True, text=True, timeout=60)
    return json.loads(done.stdout)[0]


def first(tags, *names):
    """The first number among these tags, or NaN."""
    return next((float(tags[name]) for name in names if name in tags), math.nan)


def compare(path):
    """Whether a photograph says the same to ExifTool and to us."""
    tags, ours = tags_of(path), read_photo(path)
    assert (ours.width_px, ours.height_px) == (tags["File:ImageWidth"], tags["File:ImageHeight"])
    theirs = [first(tags, f"Composite:GPS{name}") for name in ("Latitude", "Longitude")]
    assert ours.latlon_deg == pytest.approx(theirs, abs=1e-7)
    assert ours.alt_m == pytest.approx(first(tags, "GPS:GPSAltitude"), abs=0.01)
    names = ("Yaw", "Pitch", "Roll")
    gimbal = [first(tags, f"XMP-drone-dji:Gimbal{n}Degree", f"DJI:Camera{n}") for n in names]
    if math.isfinite(sum(gimbal)):
        assert ours.gimbal_deg == pytest.approx(gimbal, abs=1e-4)
    else:
        assert ours.gimbal_deg is None
    body = first(tags, "XMP-drone-dji:FlightYawDegree", "DJI:Yaw")
    assert ours.body_yaw_deg == pytest.approx(body, abs=1e-4, nan_ok=True)
    above = first(tags, "XMP-drone-dji:RelativeAltitude", "XMP-sensefly:Height")
    assert ours.home_m == pytest.approx(above, abs=1e-6, nan_ok=True)
    assert ours.amsl_m == pytest.approx(
        first(tags, "XMP-sensefly:AltitudeAMSL"), abs=1e-6, nan_ok=True
    )
    assert ours.optics.focal_mm == pytest.approx(
        first(tags, "ExifIFD:FocalLength"), abs=1e-3, nan_ok=True
    )
    assert ours.optics.film_mm == pytest.approx(
        first(tags, "ExifIFD:FocalLengthIn35mmFormat"), nan_ok=True
    )
    utc = tags.get("XMP-sensefly:UTCTime", tags["ExifIFD:DateTimeOriginal"])
    taken = datetime.strptime(utc, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    assert ours.time_ns // 10**9 == round(taken.timestamp())
    compare_pose(ours, tags)


def compare_pose(ours, tags):
    """Heading and tilt: of the gimbal, of the body where a camera has none."""
    (photo,), _ = posed([ours], [])
    pose = photo.pose
    heading = first(tags, "XMP-drone-dji:GimbalYawDegree", "DJI:CameraYaw", "XMP-sensefly:Heading")
    pitch = first(tags, "XMP-drone-dji:GimbalPitchDegree", "DJI:CameraPitch")
    ahead = pitch + 90 if math.isfinite(pitch) else first(tags, "XMP-sensefly:PitchAngle")
    if heading == 0 == pitch:  # a gimbal that was not recorded
        heading, ahead = first(tags, "XMP-drone-dji:FlightYawDegree"), 0.0
    assert math.remainder(pose["yaw_deg"] - heading, 360) == pytest.approx(0, abs=1e-3)
    assert pose["pitch_deg"] == pytest.approx(ahead, abs=1e-3)
    roll = first(tags, "XMP-sensefly:RollAngle")
    assert pose["roll_deg"] == pytest.approx(0 if math.isnan(roll) else roll, abs=1e-3)


@needs_exiftool
@pytest.mark.parametrize("path", ["dji", "notes", "sensefly", *recorded("photos", ".jpg")])
def test_photographs_say_the_same_to_exiftool(tmp_path, path):
    compare(path if isinstance(path, Path) else made(path, tmp_path))


@pytest.mark.parametrize("path", recorded("photos", ".jpg"))
def test_recorded_photographs_have_a_believable_camera(path, tmp_path):
    (tmp_path / path.name).symlink_to(path)
    recording = open_source(tmp_path)
    camera, (view,) = recording.camera, recording.views
    field = math.degrees(2 * math.atan(camera.width_px / (2 * camera.fx_px)))
    assert 30 < field < 85 and 0 < camera.focal_std <= 0.06
    assert not {"yaw_deg", "pitch_deg", "roll_deg"} & set(view.telemetry.missing())


# Logs of PX4: pyulog's values, with angles and times worked out here.


def compare_ulog(path):
    """Heading, tilt, position, heights and times of a ULog."""
    track, log = read_log(path, DOWN), ULog(str(path))
    gps = log.get_dataset("vehicle_gps_position").data
    body = log.get_dataset("vehicle_attitude").data
    shift_us = int(np.median((gps["time_utc_usec"] - gps["timestamp"]).astype(np.int64)))
    w, x, y, z = (body[f"q[{i}]"].astype(float) for i in range(4))
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    pitch = np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))
    roll = np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    for i in range(0, len(w), max(1, len(w) // 40)):
        ours = track.telemetry((int(body["timestamp"][i]) + shift_us) * 1000)
        assert math.remainder(ours.yaw_deg - yaw[i], 360) == pytest.approx(0, abs=0.05)
        assert (ours.pitch_deg, ours.roll_deg) == pytest.approx((pitch[i], roll[i]), abs=0.05)
    for i in range(len(gps["lat"])):
        time_ns = (int(gps["timestamp"][i]) + shift_us) * 1000
        lat, lon = track.latlon_deg(time_ns)
        assert (lat, lon) == pytest.approx((gps["lat"][i] / 1e7, gps["lon"][i] / 1e7), abs=1e-6)
        ours = track.telemetry(time_ns)
        assert ours.amsl_m == pytest.approx(gps["alt"][i] / 1000, abs=0.05)
        if "alt_ellipsoid" in gps:
            assert ours.hae_m == pytest.approx(gps["alt_ellipsoid"][i] / 1000, abs=0.05)
    return track


@pytest.mark.parametrize("path", recorded("logs", ".ulg"))
def test_a_log_of_px4_says_the_same_to_pyulog(path):
    track, log = compare_ulog(path), ULog(str(path))
    local = log.get_dataset("vehicle_local_position").data
    assert track.home.values[:, 0] == pytest.approx(-local["z"].astype(float), abs=1e-3)
    sensors = {one.name for one in log.data_list} & {"distance_sensor"}
    assert bool(track.heights) == bool(sensors)


# Subtitles: no library reads all dialects; places are checked against what the samples say.

SRT_PLACES = {"matrice_300.srt": (36.6, -6.1), "m2zoom.SRT": (31.45, 74.4)}
SRT_PLACES |= {"old_format.SRT": (-20.25, 149.0)}


@pytest.mark.parametrize("path", recorded("subtitles", ".srt"))
def test_recorded_subtitles_are_in_their_country(path):
    track = read_srt(path)
    expected = SRT_PLACES.get(path.name)
    if expected is None:
        pytest.skip(f"the place of {path.name} is not known here")
    assert track.position.values[:, :2] == pytest.approx(
        np.tile(expected, (len(track.position.values), 1)), abs=0.1
    )
    heights = re.findall(r"(?:BAROMETER|Hb):([\d.]+)", path.read_text())
    if heights:
        seen = {round(float(value), 2) for value in track.home.values[:, 0]}
        assert seen <= {float(height) for height in heights}
