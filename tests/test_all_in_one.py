"""`orthonav run`: a recording and an orthophoto in, positions and a page out."""

import re
import shutil
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import pytest

from helpers import change_rows, shorten
from orthonav.core.flight import read_truth
from orthonav.core.flight.fixes import read_results
from orthonav.core.mapfile import open_map


@pytest.fixture(autouse=True)
def fewer_crops(map_path, monkeypatch):
    """Calibration from few crops, but for the map that all tests share."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    monkeypatch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 1)


@pytest.fixture
def few(flight_path, tmp_path):
    """The first views of the flight."""
    return shorten(shutil.copytree(flight_path, tmp_path / "flight"), 5)


def test_an_orthophoto_and_a_flight_become_a_page(run, area, few, tmp_path, names_in):
    out = tmp_path / "out"
    done = run("run", few, "--map", area.past, "--out", out)
    assert done.code == 0, done.err
    assert "building the map" in done.err and "localizing the views" in done.err
    top = {name.partition("/")[0] for name in names_in(out)}
    assert top == {"area.onav", "fixes.jsonl", "truth.csv", "report"}
    assert set(read_truth(out / "truth.csv")) == {f"{i:04d}.jpg" for i in range(1, 6)}
    results = read_results(out / "fixes.jsonl")
    assert len(results) == 5 and all(each.state for each in results)  # tracked
    page = Path(url2pathname(urlparse(re.search(r"open it: (\S+)", done.out)[1]).path))
    assert page == out / "report" / "index.html" and page.is_file()
    assert f"orthonav view {out}/fixes.jsonl --map {out}/area.onav --flight {few}" in done.out
    assert open_map(out / "area.onav").manifest.imagery[0]["name"] == area.past.name
    (out / "notes.txt").write_text("mine")
    again = run("run", few, "--map", out / "area.onav", "--out", out)
    assert again.code == 1 and "what no run wrote (notes.txt)" in again.err
    (out / "notes.txt").unlink()
    again = run("run", few, "--map", out / "area.onav", "--out", out)  # resumed
    assert again.code == 0 and "building the map" not in again.err and page.is_file()


def test_views_far_apart_in_time_are_localized_one_by_one(run, map_path, few, tmp_path):
    change_rows(few / "telemetry.csv", lambda number, row: row.update(time_s=60 * number))
    assert run("run", few, "--map", map_path, "--out", tmp_path / "out").code == 0
    results = read_results(tmp_path / "out" / "fixes.jsonl")
    assert len(results) == 5 and not any(each.state for each in results)


def test_nothing_is_lost_where_an_input_is_missing(run, map_path, few, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fixes.jsonl").write_text("earlier")
    for more in (("--map", tmp_path / "none.tif"), ("--map", map_path, "--dem", "none.tif")):
        done = run("run", few, *more, "--out", tmp_path / "out")
        assert done.code == 1 and "does not exist" in done.err
    assert (tmp_path / "out" / "fixes.jsonl").read_text() == "earlier"


def test_without_recorded_positions_the_views_are_localized_only(run, map_path, few, tmp_path):
    (few / "truth.csv").unlink()
    done = run("run", few, "--map", map_path, "--out", tmp_path / "out", "-q")
    assert (done.code, done.err) == (0, "") and "5 views: " in done.out
    assert "there is no report" in done.out and not (tmp_path / "out" / "report").exists()
