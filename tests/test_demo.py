"""The demo runs all steps and leaves self-contained reports."""

import json
import re
import shutil
from pathlib import Path

import pytest
from lab.demo_imagery import write_terrain

from orthonav.cli import build, demo, main
from orthonav.ground.check.run import TrialNumbers


@pytest.fixture
def small_demo(area, monkeypatch, tmp_path_factory):
    """The demo on the small area instead of its own imagery."""
    imagery = tmp_path_factory.mktemp("imagery")
    for path in (area.past, area.present):
        shutil.copy(path, imagery)
    write_terrain(area.past, imagery / "dem.tif")
    monkeypatch.setattr(demo, "IMAGERY", imagery)
    turns = tuple((east * 0.45, north * 0.35) for east, north in demo.WAYPOINTS_EN_M)
    monkeypatch.setattr(demo, "WAYPOINTS_EN_M", turns)
    monkeypatch.setattr(demo, "SPACING_M", 200.0)
    monkeypatch.setattr(demo, "CHECK_EFFORT", 0.05)
    monkeypatch.setattr("orthonav.ground.check.run.TRIALS", TrialNumbers(fewest=24))
    monkeypatch.setattr("orthonav.ground.check.run.usable_cores", lambda: 1)
    monkeypatch.setattr("orthonav.ground.report.drawing.DPI", 30)
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    monkeypatch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 1)
    asked = build.asked
    monkeypatch.setattr(build, "asked", lambda *of: asked(*of) | {"calibration_views": 2})


@pytest.mark.long
def test_the_demo(small_demo, tmp_path, capsys, names_in):
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert f"{out}/report/index.html" in printed.out and "4/4" in printed.err
    (picture,) = [word for word in printed.out.split() if word.endswith(".png")]
    assert picture.startswith(f"{out}/") and Path(picture).read_bytes().startswith(b"\x89PNG")
    assert f"{out}/check/index.html" in printed.out and "\ncheck      " in printed.out
    assert json.loads((out / "check" / "check.json").read_text())["route"]["name"] == "demo"
    names = [name for name in names_in(out) if not name.startswith(("flight/", "."))]
    assert {"area.onav", "demo.json", "check", "fixes.jsonl", "flight", "report"} <= set(names)
    metrics = json.loads((out / "demo.json").read_text())
    assert metrics["n_views"] > 7 and metrics["coverage"] > 0.9
    page = (out / "report" / "index.html").read_text()
    assert "data:image/svg+xml;base64," in page
    assert {"index.html", "figures/map.svg", "figures/map.png"} <= set(names_in(out / "report"))
    linked = re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?([^"\'>)\s]{1,40})', page)
    assert linked and all(link.startswith(("data:", "#")) for link in linked)
    assert "<script src" not in page and "@import" not in page


@pytest.mark.slow
def test_the_demo_may_be_repeated_but_replaces_nothing_else(
    small_demo, tmp_path, capsys, names_in, monkeypatch
):
    monkeypatch.setattr(demo, "SPACING_M", 240.0)
    out = tmp_path / "demo"
    out.mkdir()
    (out / "mine").write_text("mine")
    assert main(["demo", "--out", str(out)]) == 1
    assert "not empty" in capsys.readouterr().err and names_in(out) == ["mine"]
    (out / demo.MARKER).write_text('{"made_by": "orthonav demo"}')
    assert main(["demo", "--out", str(out)]) == 1 and (out / "mine").exists()
    (out / "mine").unlink()  # what is left is what an earlier demo might have made
    capsys.readouterr()
    assert main(["demo", "--quiet", "--json", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["n_views"] > 4 and printed.err == ""


def test_a_demo_that_fails_leaves_nothing(small_demo, tmp_path, capsys, names_in, monkeypatch):
    def broken(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("orthonav.ground.build.build_map", broken)
    assert main(["demo", "--quiet", "--out", str(tmp_path / "demo")]) == 130
    assert capsys.readouterr().err == "orthonav: error: interrupted; nothing was written\n"
    assert names_in(tmp_path) == []
