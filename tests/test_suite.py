"""Tests run together, however they are chosen: names are for all."""

import re
import tomllib
from collections import Counter
from pathlib import Path

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
        if name not in ("test", "dev", "docs", "ros2")  # no test imports rclpy
        for line in lines
    }
    modules = {module_of(name).partition(".")[0] for name in packages - {"orthonav"}}
    assert modules <= set(absent.EXTRA_OF)
