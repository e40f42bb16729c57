"""The program gives the same fixes on every machine and runs under conditions that are not its own.

`tools/platforms/fixes.py` made the stored map, flight and fixes.
"""

import json
import os
import shutil
import subprocess
import sys
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


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which("buildah") and shutil.which("mmdebstrap")), reason="no builder"
)
def test_the_container_places_views(tmp_path):
    script = ROOT / "tools" / "platforms" / "container.sh"
    done = subprocess.run([script, tmp_path, "debian"], capture_output=True, text=True)
    assert done.returncode == 0 and "19 fixes" in done.stdout, done.stderr
