"""A core-only install: each command works, or names in one line what to install."""

import json
import platform
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from helpers import shorten
from orthonav.cli import COMMANDS, version
from orthonav.cli.version import NEEDS
from orthonav.core import extras

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
FOR_DEVELOPERS = {"dev", "docs", "matchers", "test"}
USED = sorted({extra for needed in NEEDS.values() for extra in needed})

BLOCKED = """
import sys
blocked = set(sys.argv.pop(1).split(","))

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
from orthonav.cli import main
"""
ONE = "sys.exit(main())"
SEVERAL = """
import contextlib, io, json, logging

root, results = logging.getLogger(), []
for words in json.loads(sys.argv[1]):
    root.handlers = []
    with contextlib.redirect_stdout(io.StringIO()) as out:
        with contextlib.redirect_stderr(io.StringIO()) as err:
            code = main(words)
    results.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(results))
"""

AREA = "--bounds=3.0,46.0,3.01,46.01"
CORE_COMMANDS = {
    "info MAP": None,
    f"plan --camera CAMERA --agl-m 270 {AREA}": None,
    "evaluate FIXES --truth FLIGHT/truth.csv": "geo",
    "demo --out new": "geo,report,web",
    "simulate --ortho MAP --random 3 --out new": "geo",
    f"fetch {AREA} --source ign:2021 --out new.tif": "fetch",
    "build --ortho MAP --out new.onav": "geo",
    "atlas build new --ortho MAP": "geo",
    "atlas check new": "geo",
    "check MAP --agl-m 270 --out new": "geo,report,web",
    "plan --camera CAMERA --agl-m 270 --route ROUTE --band-m 300 --dem MAP": "geo",
    "sign MAP --new-key new": "signing",
    "verify MAP --key MAP": "signing",
    "import FLIGHT/frames --out new": "flights",
    "localize MAP FLIGHT/frames --out new.jsonl": "flights",
    "locate-pixel FIXES 0001.jpg 10 10 --flight FLIGHT": None,
    "calibrate MAP FLIGHT/frames --out new.json": "flights",
    "localize memory://new FLIGHT --out new.jsonl": "atlas",
    "localize MAP FLIGHT --require-signed MAP --out new.jsonl": "signing",
    "fly MAP FLIGHT --autopilot udpin:127.0.0.1:0 --dry-run": "autopilot",
    "fly MAP FLIGHT --recorded-telemetry --log new.mcap": "autopilot",
    "fly MAP --ros2 --dry-run": "flights",
    "view FIXES --map MAP": "web",
}
"""Commands of a core-only install, and the extras that the answer names; None: it works."""


def top_modules(extra):
    return {extras.module_of(package.name).partition(".")[0] for package in extras.packages(extra)}


def core_only(*arguments, cwd, script=ONE):
    """A command, or a script with its arguments, where nothing but the core can be imported."""
    optional = set().union(*(top_modules(extra) for extra in USED)) - top_modules("")
    words = [sys.executable, "-B", "-c", BLOCKED + script, ",".join(sorted(optional)), *arguments]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def fixes(map_path, flight_path, tmp_path_factory):
    """Fixes of the first views of the flight, made by the core alone."""
    folder = tmp_path_factory.mktemp("fixes")
    few = shorten(shutil.copytree(flight_path, folder / "flight"), 3)
    done = core_only("localize", map_path, few, "--out", "fixes.jsonl", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "fixes.jsonl"


@pytest.fixture(scope="module")
def answers(fixes, map_path, flight_path, tmp_path_factory):
    """(exit code, stdout, stderr) of each command, all in one process, and its folder."""
    folder = tmp_path_factory.mktemp("core")
    route = folder / "route.csv"
    route.write_text("lat_deg,lon_deg\n46.0,3.0\n46.01,3.01\n")
    paths = {"MAP": map_path, "FLIGHT": flight_path, "FIXES": fixes, "ROUTE": route}
    paths["CAMERA"] = flight_path / "flight.json"
    commands = [
        [re.sub(r"^[A-Z]+", lambda m: str(paths.get(m[0], m[0])), word) for word in line.split()]
        for line in CORE_COMMANDS
    ]
    done = core_only(json.dumps(commands), cwd=folder, script=SEVERAL)
    assert done.returncode == 0, done.stderr
    return dict(zip(CORE_COMMANDS, json.loads(done.stdout), strict=True)), folder


@pytest.mark.parametrize("line", CORE_COMMANDS)
def test_a_core_only_install_works_or_names_the_extras(line, answers):
    done, folder = answers
    code, out, err = done[line]
    named = CORE_COMMANDS[line]
    if named is None:
        assert code == 0, err
        return
    assert (code, out) == (1, "")
    assert err.startswith("orthonav: error: ") and err.count("\n") == 1
    assert f"pip install 'orthonav[{named}]'" in err
    assert not list(folder.glob("new*"))


def test_the_version_report_names_what_is_missing(tmp_path):
    done = core_only("--version", "--json", cwd=tmp_path)
    plain = json.loads(done.stdout)
    assert set(plain["missing"]) == set(NEEDS)
    assert plain["missing"]["check"] == "pip install 'orthonav[geo,report,web]'"
    assert plain["extras"]["geo"]["rasterio"] is None
    assert plain["core"]["numpy"] == metadata.version("numpy")
    assert plain["processor"]["cores"] >= 1 and plain["processor"]["features"]
    assert core_only("--version", "--verbose", cwd=tmp_path).stdout == done.stdout


def test_every_extra_of_users_is_in_the_table():
    assert set(USED) == set(PROJECT["optional-dependencies"]) - FOR_DEVELOPERS
    assert {key.split(" ")[0].rstrip(",") for key in NEEDS} <= set(COMMANDS)


def test_modules_are_those_of_the_packages():
    """What an extra's package is called when imported, by the files that pip installed."""
    installed = metadata.packages_distributions()

    def plain(name):
        return re.sub(r"[-_.]+", "-", name).lower()

    names = {package.name for extra in ("", *USED) for package in extras.packages(extra)}
    here = {plain(name) for found in installed.values() for name in found}
    of_module = {
        name: map(plain, installed.get(extras.module_of(name).partition(".")[0], []))
        for name in names
        if plain(name) in here
    }
    assert of_module and all(plain(name) in found for name, found in of_module.items())


@pytest.mark.parametrize(
    ("machine", "python", "available"),
    [("x86_64", "3.14.2", True), ("aarch64", "3.14.2", False), ("x86_64", "3.15.0", False)],
)
def test_what_is_not_made_for_a_machine_is_not_called_missing(
    monkeypatch, machine, python, available
):
    """By the markers of the wheels of ROS, as pip writes them."""
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(platform, "python_version", lambda: python)
    monkeypatch.setattr(extras, "_version", lambda name: "")
    found = {package.name: package for package in extras.packages("ros2")}
    of_ros = {name for name in found if name.startswith("ros-")}
    assert {found[name].available for name in of_ros} == {available} and found["rosbags"].available
    plain = version.about()
    assert set(plain["unavailable"]) == (set() if available else of_ros)
    answer = plain["missing"]["fly --ros2"]
    assert ("no wheel for this machine" in answer) is not available
    assert ("pip install" in answer) is available
