"""Tests run together, however they are chosen: names are for all. And every run ends."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

import absent
from orthonav.core.extras import module_of

ROOT = Path(__file__).resolve().parents[1]
TESTS = sorted(Path(__file__).parent.rglob("*.py"))


def test_no_two_modules_have_one_name():
    counted = Counter(path.name for path in TESTS if path.name != "conftest.py")
    assert [name for name, count in counted.items() if count > 1] == []


def test_nothing_is_imported_from_conftest():
    """Any folder may have one of its own, and the last one loaded is what the name means."""
    importing = re.compile(r"^\s*(from|import) conftest", re.MULTILINE)
    assert [path.name for path in TESTS if importing.search(path.read_text("utf-8"))] == []


FAULTS = {
    "crash": "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
    "sleep": "import time; time.sleep(1000)",
    # No signal reaches Python while this runs.
    "deaf": "import itertools; sum(itertools.repeat(1))",
}


@pytest.mark.slow  # four processes; a suite that hangs shows it by itself
def test_a_run_ends_with_the_names_of_the_tests_that_crashed_or_hung(tmp_path):
    """Under the command of `make test` and the project's own options, but for shorter limits."""
    (tmp_path / "test_quick.py").write_text("def test_one(): pass\ndef test_two(): pass\n")
    for name, fault in FAULTS.items():
        broken = f"def test_before(): pass\ndef test_broken(): {fault}\ndef test_after(): pass\n"
        (tmp_path / f"test_{name}.py").write_text(broken)
    makefile = (ROOT / "Makefile").read_text("utf-8")
    options = re.search(r"^PYTEST := \$\(BIN\)/python (.*)$", makefile, re.MULTILINE)
    assert options
    command = [sys.executable, *shlex.split(options[1]), "-p", "no:cacheprovider"]
    limits = ["-o", "timeout=1", "-o", "faulthandler_timeout=2"]
    done = subprocess.run(
        [*command, "-c", str(ROOT / "pyproject.toml"), *limits, "--rootdir", ".", "."],
        cwd=tmp_path,
        env={**os.environ, "PYTEST_XDIST_AUTO_NUM_WORKERS": "3"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1, done.stdout
    for name in FAULTS:
        assert re.search(rf"^FAILED test_{name}.py::test_broken", done.stdout, re.MULTILINE)
    assert re.search(r"^3 failed, [1-9] passed", done.stdout, re.MULTILINE)


def test_only_what_is_absent_skips_a_test(monkeypatch):
    monkeypatch.setattr(absent, "ABSENT", {"torch": "train"})
    assert absent._reason("E   ModuleNotFoundError: No module named 'torch.nn'")
    assert absent._reason(
        "Done(code=1, err=\"learning needs PyTorch: pip install 'orthonav[train]'\")"
    )
    assert absent._reason("E   ModuleNotFoundError: No module named 'rasterio'") is None
    assert absent._reason("pip install 'orthonav[geo]'") is None
    assert absent._reason("AssertionError: assert 1 == 2") is None


def test_every_package_of_an_extra_is_known_to_be_optional():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert set(absent.EXTRA_OF.values()) <= set(extras)
    packages = {
        re.split(r"[\[<>=]", line)[0]
        for name, lines in extras.items()
        if name not in ("test", "dev", "docs")
        for line in lines
    }
    modules = {module_of(name).partition(".")[0] for name in packages - {"orthonav"}}
    assert modules <= set(absent.EXTRA_OF)
