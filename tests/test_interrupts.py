"""What an interrupt says of the results that are written, and what it skips."""

import shutil

import pytest

from helpers import change_rows, shorten
from orthonav.core.flight.fixes import read_results


@pytest.fixture
def turned(flight_path, tmp_path):
    """Two views of a flight whose headings are off by 180 degrees."""

    def turn(number, row):
        row["yaw_deg"] = (float(row["yaw_deg"]) + 180) % 360

    folder = shorten(shutil.copytree(flight_path, tmp_path / "turned"), 2)
    change_rows(folder / "telemetry.csv", turn)
    return folder


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_an_interrupt_of_the_search_for_another_set_up_skips_it(
    run, map_path, turned, tmp_path, monkeypatch
):
    monkeypatch.setattr("orthonav.ground.recordings.setups.try_setups", interrupted)
    command = ["localize", map_path, turned, "--out", tmp_path / "fixes.jsonl"]
    done = run(*command)
    assert (done.code, done.err) == (0, "")
    assert "! the search for another configuration was interrupted" in done.out
    assert f"written to {tmp_path / 'fixes.jsonl'}" in done.out
    assert len(read_results(tmp_path / "fixes.jsonl")) == 2
    assert "!" not in run(*command, "--quiet").out


def test_the_search_for_another_set_up_ends_in_time(run, map_path, turned, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.cli.localize.BUDGET_S", 0.0)
    done = run("localize", map_path, turned, "--out", tmp_path / "fixes.jsonl")
    said = "! the search for another configuration was ended after 0 s"
    assert done.code == 0 and said in done.out


def test_an_interrupt_names_what_is_written(run, map_path, flight_path, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.ground.recordings.setups.Counts.of", interrupted)
    fixes, cameras = tmp_path / "fixes.jsonl", tmp_path / "cameras.csv"
    done = run("localize", map_path, flight_path, "--out", fixes, "--export", f"csv={cameras}")
    assert done == (130, "", f"orthonav: error: interrupted; written: {fixes}, {cameras}\n")
