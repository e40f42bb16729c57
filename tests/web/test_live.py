"""A run is followed while it is flown, whatever its file goes through."""

import json

import numpy as np
import pytest
from blots import CAMERA
from small_run import result

from helpers import wait_for
from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.flight.fixes import result_to_json
from orthonav.core.records import Telemetry
from orthonav.ground.view import feed as feed_module
from orthonav.ground.view.feed import LineFeed, LogReader
from orthonav.ground.view.run import ViewRequest, open_run
from orthonav.onboard.log import FlightLog

HEALTH = {"health": "DEGRADED", "reasons": ["searching"], "utc_s": 1.5, "counts": {"taken": 3}}


def line(i):
    return result_to_json(result(i)) + "\n"


@pytest.fixture
def fixes(tmp_path):
    return tmp_path / "live.jsonl"


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(feed_module, "RESCAN_S", 0.0)


def test_a_file_that_grows(fixes):
    """Half a line is waited for; each result is delivered once."""
    feed = LineFeed(fixes, live=True)
    assert feed.poll().results == []
    fixes.write_text(line(0) + line(1)[:40])
    assert [each.frame for each in feed.poll().results] == [result(0).frame]
    with fixes.open("a") as out:
        out.write(line(1)[40:] + line(2))
    assert [each.frame for each in feed.poll().results] == [result(1).frame, result(2).frame]
    assert feed.poll().results == []


def test_a_file_that_is_begun_anew(fixes):
    feed = LineFeed(fixes, live=True)
    fixes.write_text(line(0) + line(1))
    assert not feed.poll().restarted
    fixes.write_text(line(2))
    batch = feed.poll()
    assert batch.restarted and [each.frame for each in batch.results] == [result(2).frame]


def test_broken_lines_are_reported_and_skipped(fixes):
    fixes.write_text(line(0) + '{"frame": 3\n{"health": 4}\n\xff\n\n' + line(1))
    batch = LineFeed(fixes).poll()
    assert len(batch.results) == 2 and len(batch.problems) == 1
    assert "line 2 was skipped" in batch.problems[0]


def test_lines_and_files_beyond_reason(fixes, monkeypatch):
    fixes.write_text(line(0) + "x" * (feed_module.MAX_LINE_BYTES + 10) + "\n" + line(1))
    assert len(LineFeed(fixes).poll().results) == 2
    monkeypatch.setattr(feed_module, "MAX_VIEWS", 1)
    with pytest.raises(FlightError, match="more than 1 views"):
        LineFeed(fixes).poll()


def test_a_run_tells_news_and_begins_anew(fixes, small):
    run = open_run(ViewRequest(fixes, small.map_path, live=True))
    assert run.news(0, 0, 0)["count"] == 0
    fixes.write_text(line(0) + json.dumps(HEALTH) + "\n" + line(1))
    news = run.news(1, 0, 0)
    assert (news["first"], news["count"], news["health"][0]["view"]) == (0, 2, 1)
    with fixes.open("a") as out:
        out.write(line(2))
    later = run.news(news["generation"], 2, 1)
    assert later["first"] == 2 and later["columns"]["t"] == [2] and later["health"] == []
    fixes.write_text(line(3))
    after = run.news(news["generation"], 3, 1)
    assert after["generation"] != news["generation"] and after["first"] == 0 and after["count"] == 1
    fixes.write_text("")
    fixes.write_text("\n")
    assert run.news(after["generation"], 1, 0)["count"] == 0


def telemetry(i):
    return Telemetry((100 + i) * 10**9, 40.0 + 10 * i, 4.0, -3.0, 60.0)


def write_log(folder, numbers, *, views="full", close=True):
    log = FlightLog(folder / "flight.mcap", CAMERA, {"name": "x"}, views=views, chunk_s=0.01)
    fly(log, numbers)
    if close:
        log.close()
    return log


def fly(log, numbers):
    for i in numbers:
        grey = np.random.default_rng(i).integers(0, 256, (240, 320), dtype=np.uint8)
        log.view(i, result(i).frame, grey, telemetry(i))
        log.result(result(i))
        log.health(HEALTH)


def gathered(reader, count):
    """So many results and lines of health; the log is written by a thread of its own."""
    results, health = [], []

    def all_there():
        batch = reader.poll()
        results.extend(batch.results)
        health.extend(batch.health)
        return min(len(results), len(health)) >= count

    wait_for(all_there)
    assert len(results) == count
    return results, health


def test_a_log_while_it_is_written(tmp_path):
    reader = LogReader(tmp_path / "flight.mcap", live=True)
    assert reader.poll().results == []
    log = write_log(tmp_path, range(2), close=False)
    first, _ = gathered(reader, 2)
    assert [each.frame for each in first] == [result(0).frame, result(1).frame]
    fly(log, range(2, 4))
    log.close()
    later, health = gathered(reader, 2)
    assert [each.frame for each in later] == [result(2).frame, result(3).frame]
    assert [before for before, _ in health] == [3, 4]
    shot = reader.shot(result(3).frame)
    assert shot.camera == CAMERA and shot.telemetry == telemetry(3)
    expected = np.random.default_rng(3).integers(0, 256, (240, 320), dtype=np.uint8)
    assert np.array_equal(shot.load(), expected)


def test_another_flight_of_that_name(tmp_path):
    """Live, the newest is followed; else one must be named."""
    write_log(tmp_path, range(2))
    reader = LogReader(tmp_path / "flight.mcap", live=True)
    assert len(reader.poll().results) == 2
    write_log(tmp_path, range(2, 5))
    batch = reader.poll()
    assert batch.restarted and len(batch.results) == 3
    with pytest.raises(FlightError, match="flights"):
        LogReader(tmp_path / "flight.mcap").poll()
    assert len(LogReader(tmp_path / "flight_0001.mcap").poll().results) == 2


def test_another_flight_in_files_of_the_same_name(tmp_path):
    write_log(tmp_path, range(4), close=False)
    reader = LogReader(tmp_path / "flight.mcap", live=True)
    gathered(reader, 4)
    for path in tmp_path.glob("*.mcap"):
        path.unlink()
    write_log(tmp_path, range(4, 5))
    batch = reader.poll()
    assert batch.restarted and [each.frame for each in batch.results] == [result(4).frame]


def test_files_deleted_to_make_room_are_not_missed(tmp_path):
    log = write_log(tmp_path, range(2))
    reader = LogReader(tmp_path, live=True)
    assert log and len(reader.poll().results) == 2
    (tmp_path / "flight_0001.mcap").unlink()
    batch = reader.poll()
    assert not batch.restarted and batch.results == []
    with pytest.raises(FlightError, match="cannot be read"):
        reader.shot(result(0).frame).load()


def test_images_of_a_log_for_fixes_of_a_file(tmp_path, small):
    write_log(tmp_path, range(2))
    run = open_run(ViewRequest(small.fixes, small.map_path, flight=tmp_path))
    assert "window" in run.detail(0)
    assert run.detail(5)["why_no_window"] == "this view is not in the log"


def write_mounted_log(folder, mount):
    log = FlightLog(folder / "flight.mcap", CAMERA, {"name": "x"})
    log.options({"mount": mount})
    fly(log, range(2))
    log.close()


def test_an_invalid_mount_of_a_log_is_reported(tmp_path, small):
    write_mounted_log(tmp_path, {})
    run = open_run(ViewRequest(tmp_path, small.map_path))
    assert run.count == 2 and "invalid mount" in run.problems[0]


def test_a_log_that_is_not_there(tmp_path):
    with pytest.raises(MissingFileError, match="does not exist"):
        LogReader(tmp_path / "flight.mcap").poll()
