"""What is read of a file of fixes or of a flight log, however damaged."""

import json

import numpy as np
import pytest
from blots import CAMERA
from small_run import result

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.flight.fixes import result_to_json
from orthonav.core.records import Telemetry
from orthonav.ground.view import recorded
from orthonav.ground.view.recorded import LoggedRun, read_lines
from orthonav.ground.view.run import Run, ViewRequest
from orthonav.onboard.log import FlightLog

HEALTH = {"health": "DEGRADED", "reasons": ["searching"], "utc_s": 1.5, "counts": {"taken": 3}}


def line(i):
    return result_to_json(result(i)) + "\n"


@pytest.fixture
def fixes(tmp_path):
    return tmp_path / "fixes.jsonl"


def test_health_lies_between_the_views(fixes):
    fixes.write_text(line(0) + json.dumps(HEALTH) + "\n" + line(1))
    found = read_lines(fixes)
    assert [each.frame for each in found.results] == [result(0).frame, result(1).frame]
    (health,) = found.health
    assert (health["view"], health["level"], health["counts"]) == (1, "DEGRADED", {"taken": 3})


def test_broken_lines_are_reported_and_skipped(fixes):
    fixes.write_text(line(0) + '{"frame": 3\n{"health": 4}\n\xff\n\n' + line(1))
    found = read_lines(fixes)
    assert len(found.results) == 2 and len(found.problems) == 1
    assert "line 2 was skipped" in found.problems[0]


def test_lines_and_files_beyond_reason(fixes, monkeypatch):
    fixes.write_text(line(0) + "x" * (recorded.MAX_LINE_BYTES + 10) + "\n" + line(1))
    assert len(read_lines(fixes).results) == 2
    monkeypatch.setattr(recorded, "MAX_VIEWS", 1)
    with pytest.raises(FlightError, match="more than 1 views"):
        read_lines(fixes)


def telemetry(i):
    return Telemetry((100 + i) * 10**9, 40.0 + 10 * i, 4.0, -3.0, 60.0)


def grey(i):
    return np.random.default_rng(i).integers(0, 256, (240, 320), dtype=np.uint8)


def write_log(folder, numbers, **options):
    log = FlightLog(folder / "flight.mcap", CAMERA, {"name": "x"}, chunk_s=0.01)
    log.options(options)
    for i in numbers:
        log.view(i, result(i).frame, grey(i), telemetry(i))
        log.result(result(i))
        log.health(HEALTH)
    log.close()


@pytest.mark.parametrize("name", ["", "flight.mcap", "flight_0001.mcap"])
def test_a_log_by_its_folder_name_or_file(tmp_path, name):
    write_log(tmp_path, range(4))
    found = LoggedRun(tmp_path / name)
    assert [each.frame for each in found.results] == [result(i).frame for i in range(4)]
    assert [each["view"] for each in found.health] == [1, 2, 3, 4]
    shot = found.shot(result(3).frame)
    assert shot.camera == CAMERA and shot.telemetry == telemetry(3)
    assert np.array_equal(shot.load(), grey(3))


def test_of_several_flights_one_must_be_named(tmp_path):
    write_log(tmp_path, range(2))
    write_log(tmp_path, range(2, 5))
    with pytest.raises(FlightError, match="flights"):
        LoggedRun(tmp_path / "flight.mcap")
    assert len(LoggedRun(tmp_path / "flight_0001.mcap").results) == 2


def test_a_log_that_is_deleted_while_it_is_shown(tmp_path):
    write_log(tmp_path, range(2))
    found = LoggedRun(tmp_path)
    (tmp_path / "flight_0001.mcap").unlink()
    with pytest.raises(FlightError, match="cannot be read"):
        found.shot(result(0).frame).load()


def test_images_of_a_log_for_fixes_of_a_file(tmp_path, small):
    write_log(tmp_path, range(2))
    run = Run(ViewRequest(small.fixes, small.map_path, flight=tmp_path))
    assert "window" in run.detail(0)
    assert run.detail(5)["why_no_window"] == "this view is not in the log"


def test_an_invalid_mount_of_a_log_is_reported(tmp_path, small):
    write_log(tmp_path, range(2), mount={})
    run = Run(ViewRequest(tmp_path, small.map_path))
    assert len(run.recorded.results) == 2 and "invalid mount" in run.recorded.problems[0]


def test_a_log_that_is_not_there(tmp_path):
    with pytest.raises(MissingFileError, match="does not exist"):
        LoggedRun(tmp_path / "flight.mcap")
