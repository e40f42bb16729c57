"""Tests that need an extra which is not installed are skipped, by the name of what is missing.

Whatever imports it: the test's module, a fixture, the test, or a command that it runs. A module
counts as absent only where it really is, so that a test which hides an installed one still fails.
"""

import re
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from orthonav.core.extras import module_of, packages

EXTRA_OF = {"lz4": "flights", "zstandard": "flights"}  # that mcap brings
TABLE = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
for extra in TABLE["project"]["optional-dependencies"]:
    for package in packages(extra) if extra != "ros2" else ():  # no test imports rclpy
        EXTRA_OF.setdefault(module_of(package.name).partition(".")[0], extra)


def _installed(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ImportError:
        return False


ABSENT = {name: extra for name, extra in EXTRA_OF.items() if not _installed(name)}
MODULE = re.compile(r"ModuleNotFoundError: No module named '(\w+)")
EXTRA = re.compile(r"orthonav\[(\w+)\]")


def _reason(text: str) -> str | None:
    """Why a test that failed with this text is skipped; None where nothing absent is to blame."""
    for name in MODULE.findall(text):
        if name in ABSENT:
            return f"needs {name}, of orthonav[{ABSENT[name]}]"
    for extra in EXTRA.findall(text):
        if extra in ABSENT.values():
            return f"needs orthonav[{extra}]"
    return None


def _skip(report: pytest.TestReport | pytest.CollectReport, place: str, text: str) -> None:
    reason = _reason(text) if ABSENT and report.failed else None
    if reason:
        report.outcome = "skipped"
        report.longrepr = (place, 0, f"Skipped: {reason}")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Iterator[None]:
    """A module, or a folder's conftest, that imports what is absent."""
    report = yield
    _skip(report, str(collector.path), report.longreprtext)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """A fixture or a test that imports what is absent, or a command that asks for it."""
    report = yield
    _skip(report, str(item.path), f"{report.longreprtext}\n{call.excinfo and call.excinfo.value}")
    return report
