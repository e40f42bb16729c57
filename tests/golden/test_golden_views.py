"""Views are located as they were: 200 single views over five maps, and two tracks."""

import json

import golden_views
import pytest


@pytest.mark.long
def test_views_are_located_as_they_were(tmp_path):
    stored = json.loads(golden_views.FILE.read_text(encoding="utf-8"))
    report = golden_views.report(stored, golden_views.located(tmp_path))
    assert not report, report
