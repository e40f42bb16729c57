"""Views are located as they were: 200 single views over five maps, and two tracks.

Some 55 s of one core. `make golden` renews what is stored.
"""

import json
import math

import golden_views
import numpy as np
import pytest

from orthonav.core.records import Fix

pytestmark = pytest.mark.long
STORED = json.loads(golden_views.FILE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")


@pytest.mark.parametrize("name", golden_views.FLIGHTS)
def test_views_are_located_as_they_were(name, folder):
    golden_views.prepare(name, folder)
    results, frame = golden_views.results_of(name, folder)
    rows = [golden_views.row_of(result, frame) for result in results]
    report = golden_views.report(STORED, {name: rows})
    assert not report, report
    for fix in (each.outcome for each in results if isinstance(each.outcome, Fix)):
        assert np.linalg.eigvalsh(fix.cov_en_m2)[0] > 0
        assert not fix.confidence > fix.place_probability  # which is NaN where it is not stated
        assert not any(math.isnan(fix.protection_level_m(risk)) for risk in (0.0, 1e-3, 0.1, 1.0))
