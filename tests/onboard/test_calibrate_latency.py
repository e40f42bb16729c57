"""`orthonav calibrate --latency` from flight logs."""

import json
from dataclasses import replace

import pytest
from fake_autopilot import UTC_NS, S
from flown import SMALL, Flown

from orthonav.cli import main
from orthonav.cli.flying import _stated
from orthonav.core.errors import FlightError, OrthonavError
from orthonav.core.flight.mount import CameraLatency, read_latency, write_latency
from orthonav.onboard.log import FlightLog
from orthonav.onboard.telemetry import VehicleState

RATE_HZ = 5.0


def as_seen(grey):
    return grey


def logged(
    folder,
    flown,
    delay_s,
    *,
    used_s=0.0,
    seconds=32,
    rate_hz=RATE_HZ,
    heading_off=0.0,
    change=as_seen,
):
    """A log of a flight whose images are late, flown with another latency."""
    log = FlightLog(folder / "flight.mcap", SMALL, {})
    begin_ns = UTC_NS + 1000 * S
    for number in range(int(seconds * rate_hz)):
        arrived_s = 10.0 + number / rate_hz
        at_s = arrived_s - used_s
        _, (north, east), _ = flown.at(at_s)
        state = VehicleState(flown.ned_from_body(at_s), flown.agl_m, (north, east, 0.0))
        telemetry = state.telemetry(begin_ns + round(at_s * S))
        telemetry = replace(telemetry, yaw_deg=telemetry.yaw_deg + heading_off)
        late_s = delay_s(arrived_s) if callable(delay_s) else delay_s
        grey = change(flown.picture(arrived_s - late_s, SMALL))
        log.view(number, f"{number:06d}", grey, telemetry, used_s * 1e3, number % 3 == 0)
    log.close()
    return folder / "flight_0001.mcap"


def calibrated(log, out, *more):
    return main(["calibrate", "area.onav", str(log), "--latency", "--out", str(out), *more])


@pytest.mark.parametrize(("delay_s", "used_s"), [(0.15, 0.15), (2.2, 0.3)])
def test_the_latency_is_found(tmp_path, capsys, caplog, delay_s, used_s):
    log = logged(tmp_path, Flown(80, seed=1), delay_s, used_s=used_s)
    out = tmp_path / "latency.json"
    assert calibrated(log, out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["latency_ms"] == pytest.approx(delay_s * 1e3, abs=50)
    assert found["std_ms"] < 100 and found["pairs"] > 100
    assert "only `orthonav calibrate --latency` uses them" in caplog.text
    assert "left out" not in caplog.text
    assert _stated(str(out)) == read_latency(out) == CameraLatency(**found)


@pytest.mark.parametrize(
    ("flown", "delay_s", "options", "why"),
    [
        (Flown(80, turns=False, turbulence_deg=0.05, seed=2), 0.4, {}, "turns"),
        (Flown(80, seed=1), 0.4, {"rate_hz": 1.0}, "1.0 s apart"),
        (Flown(80, seed=1), 0.4, {"heading_off": 180.0}, "--mount-deg"),
        (Flown(80, seed=6), 0.4, {"change": lambda grey: grey[::-1, ::-1].copy()}, "--mount-deg"),
        (Flown(80, seed=1), lambda at: 0.1 + 0.1 * (at - 10), {"seconds": 60}, ""),
    ],
    ids=["straight", "rare views", "wrong heading", "rotated", "growing"],
)
def test_flights_that_do_not_show_it_are_refused(tmp_path, capsys, flown, delay_s, options, why):
    log = logged(tmp_path, flown, delay_s, **options)
    assert calibrated(log, tmp_path / "latency.json") == 1
    assert why in capsys.readouterr().err and not (tmp_path / "latency.json").exists()


def test_a_stated_latency_is_a_number_or_a_file(tmp_path):
    path = tmp_path / "latency.json"
    write_latency(path, CameraLatency(85.0, 20.0, 120))
    assert _stated(None) is None and _stated("85").latency_ms == 85.0
    assert _stated(str(path)) == CameraLatency(85.0, 20.0, 120)
    for wrong in ("-1", "20000", "nan", str(tmp_path / "absent.json")):
        with pytest.raises(OrthonavError):
            _stated(wrong)


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", '{"orthonav_latency": 2}', '{"orthonav_latency": 1}']
)
def test_damaged_files_are_refused(tmp_path, text):
    path = tmp_path / "latency.json"
    path.write_text(text)
    with pytest.raises(FlightError, match="calibrate --latency"):
        read_latency(path)
