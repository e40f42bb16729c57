"""Rows in the repository, and the page made of them."""

import json
from dataclasses import asdict

from experiments.paper import dates, results, tables
from experiments.paper.__main__ import main
from experiments.paper.methods import REDUCED, TABLE_1, methods
from experiments.paper.results import Result, compact, stored
from experiments.paper.tables import above_default

TILES = 940


def row(key="autoencoder-canny", scene="B"):
    """A row as a run of today would leave it, of four views."""
    (method,) = [each for each in methods(REDUCED, scene, TILES) if each.key == key]
    seen = [
        [0.0, 1.0, 1.5, 2.0, 0.9],
        [14.0, 1, 1.2, 1.9, 0.8],
        [99.0, 1, 1.2, 1.1, 0.1],
        [None] * 5,
    ]
    made = {
        "scene": scene,
        "trajectory": asdict(TABLE_1[scene]),
        "setting": asdict(REDUCED),
        "provenance": {"commit": "0123456789ab", "dirty": False, "date": "2026-11-01", "cpu": "x"},
        "method": asdict(method),
        "tiles": TILES,
        "dims": 1024,
        "views": dict.fromkeys(("route", "grid", "anywhere"), seen),
        "chance": {},
        "sweep": {},
        "rules": {},
        "minutes": 3.0,
        **dict.fromkeys(("learn_s", "mb_per_km2", "encoder_mb", "view_ms"), 1.0),
    }
    return Result(json.loads(compact(made)))


def test_the_page_is_made_of_the_rows_in_the_repository():
    assert tables.PAGE.read_text(encoding="utf-8") == tables.page(stored())


def test_a_page_names_commit_date_and_number_of_the_rows():
    text = tables.page([row(), row("gradient-gradient")])
    (line,) = [each for each in text.splitlines() if each.startswith("| 0123456789 ")]
    assert line.split() == ["|", "0123456789", "|", "2026-11-01", "|", "2", "|"]


def test_results_are_kept_and_the_page_follows(tmp_path, monkeypatch):
    shown = tmp_path / "page.md"
    monkeypatch.setattr(tables, "PAGE", shown)
    monkeypatch.setattr(results, "ROWS", tmp_path / "rows")
    monkeypatch.setattr("experiments.paper.curves.FIGURE", tmp_path / "epochs.png")
    folder = tmp_path / "results" / "reduced"
    folder.mkdir(parents=True)
    (folder / "B-autoencoder-canny.json").write_text(compact(row().plain))
    assert main(["keep", "--out", str(tmp_path / "results")]) == 0
    assert "| 0123456789 |" in shown.read_text()


def test_rows_above_the_default_are_named():
    ours, canny = row("gradient-gradient-registration"), row()
    for placement in ("grid", "anywhere"):
        ours.plain["views"][placement] = [[1.0, 1.0, 1.0, 1.0, 0.0]] * 4
    ours.plain["views"]["route"] = [[99.0, 1.0, 1.0, 1.0, 0.0]] * 50
    canny.plain["views"]["route"] = [[1.0, 1.0, 1.0, 1.0, 0.0]] * 50
    (table,) = above_default([canny, ours])
    expected = ["B", "route", "50", "0", "Auto-Encoder, Canny*", "100", "significant"]
    assert table.rows == [expected] and "2 of 3" in table.notes[0]
    ours.plain["views"]["route"] = [*[[1.0] * 5] * 49, [99.0] * 5]
    assert above_default([canny, ours])[0].rows[0][-1] == "within the noise"
    assert above_default([canny]) == []


def placed(key, scene, errors_m):
    """A row whose views on the grid have these errors."""
    made = row(key)
    made.plain["scene"] = scene
    made.plain["views"]["grid"] = [[error, 1.0, 1.0, 1.0, 0.0] for error in errors_m]
    return made


def test_canny_and_grey_are_compared_on_the_same_views(tmp_path, monkeypatch):
    """Differences 0, 1, 0, 1: 50 with a standard error of sqrt(1/3) / 2; and 1, 1, 1, 1."""
    alike = {"scene": "garching", "grey": 0.254, "canny": 0.5, "features": 0.02}
    (tmp_path / "dates.json").write_text(json.dumps({"scenes": [alike]}))
    monkeypatch.setattr(dates, "DATES", tmp_path / "dates.json")
    canny, grey = "autoencoder-canny", "autoencoder-gray"
    rows = [
        placed(canny, "garching", [0, 0, 99, 0]),
        placed(grey, "garching", [0, 99, 99, 99]),
        placed(canny, "aral", [0, 0, 0, 0]),
        placed(grey, "aral", [99, 99, 99, 99]),
        placed(canny, "tours", [99, 99, 99, 99]),
        placed(canny, "B", [0, 0, 0, 0]),
    ]
    (table,) = dates.table(rows)
    found = {each[0]: each[1:] for each in table.rows}
    assert list(found)[:2] == ["B", "aral"]
    shown = ["75 ± 22", "25 ± 22", "+50 ± 29"]
    assert found["garching"] == [*shown, "-", "-", "-", "-", "0.25", "0.50", "2"]
    assert found["aral"][:3] == ["100 ± 0", "0 ± 0", "+100 ± 0"]
    means = found["mean of the real scenes"]
    assert means[:3] == ["58 ± 30", "12 ± 12 (2 of 3)", "+75 ± 25 (2 of 3)"]
    assert found["Canny better / worse / equal"][2] == "1 / 0 / 1"
    assert dates.table(rows[-1:]) == []
