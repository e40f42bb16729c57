"""The program gives the same fixes on every machine and runs under conditions that are not its own.

`tools/platforms/fixes.py` made the stored map, flight and fixes.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import fixes
import pytest

from helpers import Done
from orthonav.core.flight import open_flight

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "data" / "golden_flight"
COMMAND = "import sys; from orthonav.cli import main; sys.exit(main())"
NO_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
NO_HOME = {"HOME": "/dev/null/none"}  # refused even to root


@pytest.fixture
def odd_folder(tmp_path):
    """The stored map and a few stored views in a folder with spaces and letters of any script."""
    folder = tmp_path / "käse ß 空 dir"
    shutil.copytree(GOLDEN, folder)
    telemetry = folder / "flight" / "telemetry.csv"
    telemetry.write_text("".join(telemetry.read_text().splitlines(keepends=True)[:4]))
    return folder


def run(*arguments, before=(), **environment):
    """A command in a process of its own whose environment is only what is given."""
    done = subprocess.run(
        [*before, sys.executable, "-B", "-c", COMMAND, *map(str, arguments)],
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT / "src"), **environment},
        capture_output=True,
        timeout=120,
    )
    return Done(done.returncode, *(os.fsdecode(text) for text in (done.stdout, done.stderr)))


@pytest.mark.parametrize("kind", ["views", "track"])
def test_this_machine_gives_the_stored_fixes(kind):
    stored = json.loads((GOLDEN / "fixes.json").read_text(encoding="utf-8"))["runs"][kind]
    here = fixes.places(GOLDEN / "area.onav", open_flight(GOLDEN / "flight"), kind)
    assert fixes.farthest_m(here, stored) <= fixes.LIMITS_M[kind]


@pytest.mark.long
def test_odd_folders_and_a_poor_environment(odd_folder):
    """Placed and reported, with nothing on stderr."""
    environment = NO_LOCALE | NO_HOME
    out = odd_folder / "füxes 1.jsonl"
    done = run("localize", odd_folder / "area.onav", odd_folder / "flight", "--out", out, "-q",
               **environment)  # fmt: skip
    assert (done.code, done.err) == (0, "")
    truth = odd_folder / "flight" / "truth.csv"
    done = run("evaluate", out, "--truth", truth, "--report", odd_folder / "repört", **environment)
    assert (done.code, done.err) == (0, "")
    assert (odd_folder / "repört" / "index.html").stat().st_size > 10_000


def test_a_name_that_the_locale_lacks_is_printed_escaped(odd_folder):
    done = run("info", odd_folder / "area.onav", PYTHONIOENCODING="ascii")
    assert (done.code, done.err) == (0, "") and "k\\xe4se" in done.out


def test_imagery_whose_name_the_locale_lacks_is_refused(tmp_path, make_ortho):
    """GDAL takes names in UTF-8 only."""
    ortho = make_ortho(tmp_path / "käse.tif")
    done = run("build", "--ortho", ortho, "--out", tmp_path / "a.onav", **NO_LOCALE)
    assert done.code == 1 and done.err.count("\n") == 1 and "PYTHONUTF8=1" in done.err


@pytest.mark.long
def test_no_network_is_needed(odd_folder, tmp_path):
    alone = ["unshare", "--map-root-user", "--net"]
    if subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("this machine does not let a user make a network namespace")
    out = tmp_path / "fixes.jsonl"
    done = run(
        "localize", odd_folder / "area.onav", odd_folder / "flight", "--out", out, before=alone
    )
    assert done.code == 0 and out.exists()


def containerfile():
    """The steps of `examples/Containerfile`: pairs of instruction and argument."""
    text = (ROOT / "examples" / "Containerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    return [tuple(line.split(maxsplit=1)) for line in lines]


def test_the_container_copies_and_starts_what_there_is():
    steps = containerfile()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    copied = [name for step, text in steps if step == "COPY" for name in text.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    assert {"pyproject.toml", "constraints.txt", project["readme"], "src"} <= set(copied)
    assert set(project["license-files"]) <= set(copied)
    (installed,) = [text for step, text in steps if step == "RUN"]
    extras = re.findall(r"/orthonav\[([\w,]+)\]", installed)[0].split(",")
    assert set(extras) <= project["optional-dependencies"].keys()
    last = dict(steps)
    started = json.loads(last["ENTRYPOINT"]) + json.loads(last["CMD"])
    assert started[0] in project["scripts"] and run(*started[1:]).code == 0
    users = [number for number, (step, _) in enumerate(steps) if step in ("RUN", "USER")]
    assert steps[users[-1]] == ("USER", "orthonav") and "useradd" in installed


@pytest.mark.slow
def test_the_container_places_views(tmp_path):
    """Built and run where there is a builder; else its installation, in an environment."""
    if shutil.which("buildah") and shutil.which("mmdebstrap"):
        script = ROOT / "tools" / "platforms" / "container.sh"
        done = subprocess.run([script, tmp_path, "debian"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "19 fixes" in done.stdout
        return
    (installed,) = [text for step, text in containerfile() if step == "RUN"]
    pip = shlex.split(installed.split(" && ")[0].replace("/orthonav", str(ROOT)))
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    places = tmp_path / "venv" / "bin"
    subprocess.run([places / pip[0], *pip[1:]], check=True)
    flown = [places / "orthonav", "localize", GOLDEN / "area.onav", GOLDEN / "flight", "--out"]
    subprocess.run([*flown, tmp_path / "fixes.jsonl"], check=True)
