"""What flies needs little: in a fresh interpreter, a fix without torch, GDAL, PROJ or plots."""

import json
import subprocess
import sys

import pytest

from absent import ABSENT

FORBIDDEN = ("torch", "rasterio", "pyproj", "shapely", "matplotlib", "osgeo")

BLOCK = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {FORBIDDEN}:
            raise ImportError(f"{{name}} must not be needed here")

sys.meta_path.insert(0, Blocked())
"""

FIX = """
import json, pathlib
from orthonav.core.flight import open_flight
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.ground.recordings.localize import localize_flight
from orthonav.onboard.run import SingleViews
from orthonav.core.flight.fixes import result_to_json

map_path, flight_path = map(pathlib.Path, sys.argv[1:])
flight = open_flight(flight_path)
alone = SingleViews(Localizer(open_map(map_path)))
results = localize_flight(alone, flight, views=flight.views[:2])
lines = [json.loads(result_to_json(result)) for result in results]
loaded = sorted({name.partition(".")[0] for name in sys.modules})
print(json.dumps({"lines": lines, "loaded": loaded}))
"""

ALL_MODULES = """
import importlib, json, os, pathlib, pkgutil, signal, sys, threading
import orthonav

before = os.getcwd(), signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
names = [m.name for m in pkgutil.walk_packages(orthonav.__path__, "orthonav.")]
for name in names:
    if not name.endswith("__main__"):
        try:
            importlib.import_module(name)
        except ImportError as error:
            # Modules of extras that are not installed; MissingExtraError says so in its cause.
            absent = (getattr(error.__cause__, "name", None) or error.name or "").partition(".")[0]
            if absent not in sys.argv[1:]:
                raise
after = os.getcwd(), signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
assert before == after, "importing changed the working directory or a signal"
assert threading.active_count() == 1, threading.enumerate()
print(json.dumps(names))
"""

HELP = """
import sys
from orthonav.cli import main

try:
    main(sys.argv[1:])
except SystemExit as left:
    assert left.code == 0
heavy = {"numpy", "cv2", "scipy", "rasterio", "matplotlib", "safetensors"} & set(sys.modules)
assert not heavy, f"--help loaded {sorted(heavy)}"
"""


def fresh(script, *arguments, cwd):
    """What a fresh interpreter prints, which must not fail or say anything on stderr."""
    command = [sys.executable, "-B", "-c", script, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_a_fix_without_heavy_libraries(map_path, flight_path, tmp_path, names_in):
    result = json.loads(fresh(BLOCK + FIX, map_path, flight_path, cwd=tmp_path))
    assert [line["status"] for line in result["lines"]] == ["fix", "fix"]
    assert not set(result["loaded"]) & set(FORBIDDEN)
    assert names_in(tmp_path) == []


@pytest.mark.slow  # starts PyTorch again
def test_importing_has_no_side_effect(tmp_path, names_in):
    names = json.loads(fresh(ALL_MODULES, *ABSENT, cwd=tmp_path))
    assert "orthonav.core.localize.localizer" in names and len(names) > 50
    assert names_in(tmp_path) == []


def test_help_loads_no_heavy_library(tmp_path):
    assert "COMMAND" in fresh(HELP, "--help", cwd=tmp_path)
    for command in ("build", "check", "import", "localize", "demo"):
        assert f"orthonav {command}" in fresh(HELP, command, "--help", cwd=tmp_path)
