"""What `import orthonav` gives, and the examples that use it."""

import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import orthonav
from orthonav.cli import main
from orthonav.core.errors import UsageError

EXAMPLES = Path(__file__).parents[1] / "examples"


def run_example(name, *arguments):
    """The output of an example."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_public_names_are_there_and_loaded_when_used():
    names = [name for name in dir(orthonav) if not name.startswith("_")]
    assert set(names) == set(orthonav.__all__) and 15 <= len(names) <= 25
    assert all(getattr(orthonav, name) is not None for name in names)
    with pytest.raises(AttributeError, match="attribute nothing"):
        orthonav.nothing  # noqa: B018 - the attribute is the test
    code = "import sys, orthonav; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_public_names_and_their_methods_are_documented():
    for name in orthonav.__all__:
        found = getattr(orthonav, name)
        if callable(found):
            parts = vars(found).items() if isinstance(found, type) else ()
            methods = {n: m for n, m in parts if callable(m) and not n.startswith("_")}
            bare = [n for n, m in {name: found, **methods}.items() if not inspect.getdoc(m)]
            assert not bare, f"{name}: {bare}"


def test_an_image_is_localized_and_followed(map_path, area, flight, flight_path):
    map_ = orthonav.open_map(str(map_path))
    localizer = orthonav.Localizer(map_)
    truth = orthonav.read_truth(flight_path / "truth.csv")
    found = []
    for seen in flight.views[:10]:
        colour = cv2.cvtColor(seen.grey(), cv2.COLOR_GRAY2BGR)
        fix = localizer.localize(colour, area.camera, agl_m=area.agl_m, heading_deg=None)
        if fix.is_confident:
            at = [localizer.sheet.frame.en_from_latlon(*each) for each in
                  ((fix.lat_deg, fix.lon_deg), truth[seen.frame])]  # fmt: skip
            found.append(np.hypot(*(at[0] - at[1])) / fix.std_m)
    assert len(found) >= 5 and np.median(found) < 3
    assert map_.contains(*truth[flight.views[0].frame]) and not map_.contains(0.0, 0.0)
    west, south, east, north = map_.bounds_deg
    lat_deg, lon_deg = truth[flight.views[0].frame]
    assert west < lon_deg < east and south < lat_deg < north
    blank = localizer.localize(colour * 0, area.camera, agl_m=area.agl_m)
    assert not blank.is_confident and blank.reason in repr(blank)
    tracker = orthonav.Tracker(map_, heading_known=False)
    first = tracker.update(colour, area.camera, time_s=0.0, agl_m=area.agl_m)
    assert isinstance(first, orthonav.Fix) and "searching" in repr(tracker)
    headless = orthonav.Tracker(map_).update(colour, area.camera, time_s=0.0, agl_m=area.agl_m)
    assert headless.reason == "missing_telemetry" and "heading_deg" in headless.detail


def test_examples_run(map_path, area, flight_path, tmp_path):
    fov_deg = 2 * np.degrees(np.arctan(area.camera.width_px / 2 / area.camera.fx_px))
    image = flight_path / "frames" / "0003.jpg"
    assert " deg" in run_example("one_image.py", map_path, image, area.agl_m, fov_deg)
    assert "Fix(" in run_example("follow_flight.py", map_path, flight_path)
    assert "MapFile(" in run_example("build_map.py", area.past, tmp_path / "a.onav", 2.5)


@pytest.mark.long
def test_types_of_the_examples_are_accepted(tmp_path):
    """By mypy, as strict as this project; programs in README and notebook too."""
    pytest.importorskip("mypy")
    readme = (EXAMPLES.parent / "README.md").read_text("utf-8")
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text("utf-8"))
    cells = ["".join(x["source"]) for x in notebook["cells"] if x["cell_type"] == "code"]
    texts = {
        "readme.py": readme.split("```python\n")[1].split("```")[0],
        "steps.py": "\n".join(cells),
    }
    for name in ("build_map.py", "follow_flight.py", "one_image.py"):
        texts[name] = (EXAMPLES / name).read_text("utf-8")
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    options = ("--strict", "--ignore-missing-imports", "--config-file=", "--follow-imports=silent")
    command = [sys.executable, "-m", "mypy", *options, *(tmp_path / name for name in texts)]
    env = {**os.environ, "MYPYPATH": str(EXAMPLES.parent / "src")}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=env)
    assert done.returncode == 0, done.stdout + done.stderr


def test_fixes_are_evaluated_and_a_check_is_refused(map_path, flight_path, tmp_path):
    fixes = tmp_path / "fixes.jsonl"
    command = ["localize", str(map_path), str(flight_path), "--out", str(fixes), "--quiet"]
    assert main(command) == 0
    metrics = orthonav.evaluate(str(fixes), flight_path / "truth.csv", radius_m=20)
    assert metrics.n_views == 30 and metrics.n_confident > 10 and metrics.radius_m == 20
    with pytest.raises(UsageError, match="agl_m must be"):
        orthonav.check(map_path, agl_m=-5.0)


def test_cells_of_the_notebook_run(map_path, flight_path, tmp_path, monkeypatch):
    demo = tmp_path / "demo"
    shutil.copytree(flight_path, demo / "flight")
    (demo / "area.onav").symlink_to(map_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text("utf-8"))
    names: dict = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert len(names["fixes"]) == 30 and len(names["errors_m"]) > 10
