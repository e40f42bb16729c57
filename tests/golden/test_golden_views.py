"""Views are located as they were: 200 single views over five maps, and two tracks.

Some 55 s of one core. `make golden` renews what is stored.
"""

import json

import golden_views
import pytest

pytestmark = pytest.mark.long
STORED = json.loads(golden_views.FILE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")


@pytest.mark.parametrize("name", golden_views.FLIGHTS)
def test_views_are_located_as_they_were(name, folder):
    report = golden_views.report(STORED, {name: golden_views.located(name, folder)})
    assert not report, report
