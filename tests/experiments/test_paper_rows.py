"""Rows in the repository: small, checked against the code they speak of, and the page of them."""

import json
from dataclasses import asdict

import pytest
from experiments.paper import stored
from experiments.paper.__main__ import main
from experiments.paper.comparison import above_default, orders
from experiments.paper.methods import methods
from experiments.paper.page import PAGE, missing, page, state
from experiments.paper.results import Result
from experiments.paper.tables import resolutions
from experiments.paper.trainings import trainings
from experiments.paper.trajectories import REDUCED, TABLE_1

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
        "code": stored.code_of(method, scene),
        "minutes": 3.0,
        **dict.fromkeys(("learn_s", "mb_per_km2", "encoder_mb", "view_ms"), 1.0),
    }
    return Result(json.loads(stored.compact(made)))


def test_the_page_is_made_of_the_rows_in_the_repository():
    assert PAGE.read_text(encoding="utf-8") == page(stored.stored(), stored.tried())


@pytest.mark.long
def test_a_row_of_todays_code_is_current():
    assert stored.older(row()) == []
    assert stored.older(row("gradient-gradient-registration")) == []


@pytest.mark.long
@pytest.mark.parametrize(
    "key, path",
    [
        ("autoencoder-canny", "src/orthonav/research/autoencoder.py"),
        ("autoencoder-canny", "src/orthonav/core/tiles/canny.py"),
        ("triplet-gray", "src/orthonav/research/triplet.py"),
        ("gradient-gradient", "src/orthonav/core/tiles/whitened.py"),
        ("gradient-gradient-registration", "src/orthonav/core/register/registrar.py"),
        ("bovw-gray-256", "src/orthonav/core/tiles/words.py"),
    ],
)
def test_a_row_older_than_its_code_is_named(key, path):
    made = row(key)
    made.plain["code"][path] = "0" * 12
    assert stored.older(made) == [path]
    (line, *_) = state([made])
    assert f"B-{key} (commit 0123456789, 2026-11-01) is older than {path}" == line


@pytest.mark.parametrize("by, expected", [(0.1, []), (-0.1, []), (0.5, [stored.GENERATED])])
def test_drawn_ground_is_the_same_up_to_rounding(by, expected):
    made = row()
    first, *others = made.plain["code"][stored.GENERATED].split()
    made.plain["code"][stored.GENERATED] = " ".join([f"{float(first) + by:.2f}", *others])
    assert stored.older(made) == expected
    for unknown in ("0123456789ab", " ".join(others)):
        made.plain["code"][stored.GENERATED] = unknown
        assert stored.older(made) == [stored.GENERATED]


def test_a_row_of_another_recipe_or_setting_is_named():
    made = row()
    made.plain["method"]["recipe"] = "autoencoder:width=8"
    made.plain["setting"]["views"] = 1
    del made.plain["code"]["src/orthonav/core/tiles/network.py"]
    assert stored.older(made) == ["src/orthonav/core/tiles/network.py", "setting", "recipe"]


def test_comments_and_docstrings_are_not_code(tmp_path):
    texts = ('"""One."""\nA = 1\n', '"""Two."""\n# more\nA = 1\n', '"""One."""\nA = 2\n')
    digests = []
    for number, text in enumerate(texts):
        path = tmp_path / f"{number}.py"
        path.write_text(text)
        digests.append(stored._digest(path))
    assert digests[0] == digests[1] != digests[2]


def test_rows_without_a_result_are_listed():
    names = missing([row()])
    assert "B-autoencoder-canny" not in names and "B-baselines" in names
    assert len(names) == len(stored.expected()) - 1
    assert "- `B-baselines`" in page([row()])


def test_a_page_names_commit_and_date_of_every_row():
    text = page([row(), row("gradient-gradient")])
    for name in ("B-autoencoder-canny", "B-gradient-gradient"):
        (line,) = [each for each in text.splitlines() if each.startswith(f"| {name} ")]
        assert "0123456789" in line and "2026-11-01" in line


def test_results_are_kept_and_the_page_follows(tmp_path, monkeypatch, capsys):
    shown = tmp_path / "page.md"
    monkeypatch.setattr("experiments.paper.page.PAGE", shown)
    monkeypatch.setattr(stored, "ROWS", tmp_path / "rows")
    folder = tmp_path / "results" / "reduced"
    folder.mkdir(parents=True)
    (folder / "B-autoencoder-canny.json").write_text(stored.compact(row().plain))
    assert main(["keep", "--out", str(tmp_path / "results")]) == 0
    assert "B-autoencoder-canny" in shown.read_text()
    assert main(["check"]) == 0
    assert "without a stored result" in capsys.readouterr().out
    shown.write_text("edited by hand")
    assert main(["check"]) == 1


def test_a_row_is_small():
    made = row().plain
    made["views"] = {"grid": [[123.456789, 0.123456, 1.234567, 2.345678, 0.98765]] * 625}
    assert len(stored.compact(made)) < 32_000


def test_the_order_of_the_papers_methods_is_compared():
    grey, canny = row("autoencoder-gray"), row()
    grey.plain["views"]["route"] = [[99.0, 1.0, 1.0, 1.0, 0.0]] * 400
    canny.plain["views"]["route"] = [[1.0, 1.0, 1.0, 1.0, 0.0]] * 400
    (table,) = orders([grey, canny])
    assert table.rows == [
        ["B", "Auto-Encoder*, Canny", "Auto-Encoder*, grey", "90.2 : 71.2", "100 : 0", "yes"]
    ]
    grey.plain["views"]["route"] = canny.plain["views"]["route"]
    (table,) = orders([grey, canny])
    assert table.rows[0][-1] == "equal"


def test_rows_above_the_default_are_named():
    ours, canny = row("gradient-gradient-registration"), row()
    for placement in ("grid", "anywhere"):
        ours.plain["views"][placement] = [[1.0, 1.0, 1.0, 1.0, 0.0]] * 50
    ours.plain["views"]["route"] = [[99.0, 1.0, 1.0, 1.0, 0.0]] * 50
    canny.plain["views"]["route"] = [[1.0, 1.0, 1.0, 1.0, 0.0]] * 50
    (table,) = above_default([canny, ours])
    expected = ["B", "route", "50", "0", "Auto-Encoder*", "Canny", "100", "significant"]
    assert table.rows == [expected] and "2 of 3" in table.notes[0]
    ours.plain["views"]["route"] = [*[[1.0] * 5] * 49, [99.0] * 5]
    assert above_default([canny, ours])[0].rows[0][-1] == "within the noise"
    assert above_default([canny]) == []


def test_trainings_are_compared_on_scenes_with_another_one():
    made = row()
    made.plain["rules"] = {"grid": {"cosine best": [3, 4]}}
    other = Result(made.plain | {"method": made.plain["method"] | {"recipe": "autoencoder"}})
    elsewhere = Result(made.plain | {"scene": "D"})
    rows = trainings([other], [made, elsewhere, other]).rows
    assert [each[:5] for each in rows] == [
        ["B", "Canny", "32", "0.0003", "188,000"],
        ["B", "Canny", str(REDUCED.encoder_batch), f"{REDUCED.encoder_rate:g}", "18,800"],
    ]
    assert rows[1][7] == "75"


def test_a_row_is_not_older_for_the_training_of_another_method():
    made = row("triplet-gray")
    made.plain["setting"]["encoder_rate"] = 1.0
    made.plain["setting"]["words"] = [1]
    assert stored.older(made) == []
    made.plain["setting"]["triplet_batch"] = 1
    assert stored.older(made) == ["setting"]


def test_results_of_another_training_are_kept_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "ROWS", tmp_path / "rows")
    folder = tmp_path / "results" / "reduced"
    folder.mkdir(parents=True)
    (folder / "B-autoencoder-canny.json").write_text(stored.compact(row().plain))
    assert stored.keep(tmp_path / "results", "reduced", "slow") == ["B-autoencoder-canny"]
    assert stored.stored() == [] and len(stored.tried()) == 1


def test_ground_resolutions_of_a_trajectory_are_compared():
    finer = row().plain | {"scene": "B-0.75m"}
    finer["trajectory"] = finer["trajectory"] | {"gsd_m": 0.75}
    (table,) = resolutions([row(), Result(finer)])
    assert [each[3:6] for each in table.rows] == [["1", "32", "69"], ["0.75", "24", "97"]]
    assert resolutions([row()]) == []
