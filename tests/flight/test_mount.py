"""A mount is written, read again, and removed from telemetry."""

import math
from dataclasses import replace

import pytest

from orthonav.core.errors import FlightError
from orthonav.core.flight.mount import Bias, Mount, read_mount, write_mount
from orthonav.core.records import Telemetry

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
    assert found.tilt_std_deg == pytest.approx(math.hypot(0.5, 0.4))
    fixed = replace(telemetry, tilt_std_deg=2.5, mount_std_deg=2.4)  # 0.7 of the horizon
    again = MOUNT.corrected(fixed)
    assert again.tilt_std_deg == pytest.approx(math.hypot(0.7, 0.4))
    assert again.mount_std_deg == 0.4 and again.horizon_std_deg == pytest.approx(0.7)


BROKEN = {
    "no JSON": lambda text: text[:-20],
    "other file": lambda _: '{"camera": 1}',
    "newer": lambda text: text.replace('"orthonav_mount": 1', '"orthonav_mount": 9'),
    "out of range": lambda text: text.replace("6.5", "650"),
    "not a number": lambda text: text.replace("6.5", "NaN"),
    "a list": lambda _: "[1, 2]",
    "huge": lambda text: text + " " * 200_000,
}


@pytest.mark.parametrize("how", BROKEN)
def test_broken_files_are_refused(tmp_path, how):
    path = tmp_path / "mount.json"
    write_mount(path, MOUNT)
    path.write_text(BROKEN[how](path.read_text()))
    with pytest.raises(FlightError, match="mount file"):
        read_mount(path)
