"""A mount is written, read again, and removed from telemetry."""

import json
import math
from functools import partial
from types import SimpleNamespace

import pytest

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.flight.mount import Bias, Mount, MountedFlight, read_mount, write_mount
from orthonav.core.records import Telemetry

Recorded = partial(SimpleNamespace, camera="camera", note="note", expected=1)
MOUNT = Mount(
    Bias(4.0, 0.5, 1.0), Bias(-0.1, 0.01, 0.02), Bias(6.5, 0.3, 0.7), Bias(-1.25, 0.4, 0.5), 17
)


def test_a_mount_comes_back(tmp_path):
    write_mount(tmp_path / "mount.json", MOUNT)
    assert read_mount(tmp_path / "mount.json") == MOUNT


def test_reported_values_are_corrected():
    telemetry = Telemetry(5, 350.0, 1.0, 2.0, 100.0, vel_en_mps=(1.0, 2.0), tilt_std_deg=0.5)
    found = MOUNT.corrected(telemetry)
    assert (found.yaw_deg, found.pitch_deg, found.roll_deg) == (354.0, 7.5, 0.75)
    assert found.agl_m == pytest.approx(100 * math.exp(-0.1))
    assert (found.time_ns, found.vel_en_mps) == (5, (1.0, 2.0))
    of_mount = max(MOUNT.pitch_deg.std, MOUNT.roll_deg.std)
    assert found.tilt_std_deg == pytest.approx(math.hypot(0.5, of_mount))


def test_unknown_values_stay_unknown():
    found = MOUNT.corrected(Telemetry(0, math.nan, 0.0, 0.0, math.nan))
    assert found.missing() == ["yaw_deg", "agl_m"]


BROKEN = {
    "no JSON": lambda text: text[:-20],
    "other file": lambda _: '{"camera": 1}',
    "newer": lambda text: text.replace('"orthonav_mount": 1', '"orthonav_mount": 9'),
    "out of range": lambda text: text.replace("6.5", "650"),
    "not a number": lambda text: text.replace("6.5", "NaN"),
    "negative": lambda text: text.replace("0.7", "-0.7"),
    "a list": lambda _: "[1, 2]",
    "deep": lambda _: "[" * 5000,
    "huge": lambda text: text + " " * 200_000,
}


@pytest.mark.parametrize("how", BROKEN)
def test_broken_files_are_refused(tmp_path, how):
    path = tmp_path / "mount.json"
    write_mount(path, MOUNT)
    path.write_text(BROKEN[how](path.read_text()))
    with pytest.raises(FlightError, match="mount file"):
        read_mount(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MissingFileError, match=r"mount file .*none\.json"):
        read_mount(tmp_path / "none.json")


def test_the_file_can_be_read_by_people(tmp_path):
    write_mount(tmp_path / "mount.json", MOUNT)
    plain = json.loads((tmp_path / "mount.json").read_text())
    assert plain["pitch_deg"] == {"value": 6.5, "std": 0.3, "scatter": 0.7}
    assert plain["views"] == 17


def test_a_missing_field_is_named(tmp_path):
    path = tmp_path / "mount.json"
    path.write_text('{"camera": 1}')
    with pytest.raises(FlightError, match="orthonav_mount is missing"):
        read_mount(path)


def test_a_flight_is_seen_without_the_errors_of_its_mount():
    flight = Recorded(
        views=(SimpleNamespace(frame="1.png", telemetry=Telemetry(5, 1.0, 2.0, 0.0, 9.0)),)
    )
    mounted = MountedFlight(flight, MOUNT)
    (view,) = mounted.views
    assert view.frame == "1.png" and view.telemetry.pitch_deg == 8.5
    assert (mounted.camera, mounted.note, mounted.expected) == ("camera", "note", 1)
