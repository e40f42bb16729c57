"""Tests run together, however they are chosen: folders are not packages, so names are for all."""

import re
from collections import Counter
from pathlib import Path

TESTS = sorted(Path(__file__).parent.rglob("*.py"))


def test_no_two_modules_have_one_name():
    counted = Counter(path.name for path in TESTS if path.name != "conftest.py")
    assert [name for name, count in counted.items() if count > 1] == []


def test_nothing_is_imported_from_conftest():
    """Any folder may have one of its own, and the last one loaded is what the name means."""
    importing = re.compile(r"^\s*(from|import) conftest", re.MULTILINE)
    assert [path.name for path in TESTS if importing.search(path.read_text("utf-8"))] == []
