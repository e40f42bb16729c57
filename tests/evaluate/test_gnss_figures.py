"""GNSS beside the map: errors, differences and alarms, in figures, JSON and report."""

import numpy as np
import pytest
from erring_flights import CENTRE, flown

from orthonav.core.flight.gnss import BIASES, FAULTS
from orthonav.ground.evaluate.metrics import compare
from orthonav.ground.evaluate.tables import gnss_rows, gnss_to_json
from orthonav.ground.evaluate.track import measure_gnss

STEP = float(FAULTS.index("gnss_step") + 1)


def measured(views, without_fix=()):
    """Of a flight to the east at 10 m a view whose fixes are 3 m off to the north. A view: metres
    by which GNSS is off to the east, None: unknown, and more evidence. `without_fix`: numbers."""
    evidence = []
    for number, (gnss_m, more) in enumerate(views):
        known = {}
        if gnss_m is not None:
            place = map(float, CENTRE.latlon_from_en([10.0 * number + gnss_m, 0.0]))
            known = dict(zip(("gnss_lat_deg", "gnss_lon_deg"), place, strict=True))
        evidence.append(known | more)
    errors = [None if number in without_fix else (0.0, 3.0) for number in range(len(views))]
    truth, results = flown(errors, "tracking", evidence=evidence)
    return measure_gnss(compare(truth, results, CENTRE), results)


def test_errors_differences_and_alarms_are_measured():
    assert measured([(None, {})] * 3) is None
    usual, fault = (4.0, {"gnss_fault": 0.0}), (40.0, {"gnss_fault": STEP})
    found = measured([*[usual] * 5, *[fault] * 3, (None, {}), usual], without_fix=(9,))
    assert found.errors_m[:6] == pytest.approx([4, 4, 4, 4, 4, 40], abs=1e-3)
    assert found.differences_m[:6] == pytest.approx([5] * 5 + [np.hypot(40, 3)], abs=1e-3)
    assert np.isnan(found.errors_m[8]) and np.isnan(found.differences_m[9])
    assert found.alarms == ((5, 8),)
    plain = gnss_to_json(found)
    assert plain["error_max_m"] == pytest.approx(40, abs=1e-3)
    assert plain["alarms"] == [{"fault": "gnss_step", "first_s": 5.0, "views": 3}]
    assert dict(gnss_rows(found))["GNSS alarms"] == "1: gnss_step"
    assert plain["learnt"] == {} and len(gnss_rows(found)) == 3


def test_what_was_learnt_is_that_of_the_last_view_that_knows_it():
    def learnt(east_m):
        numbers = [east_m, 1.0, -4.0, 1.0, 0.5, 0.25, -0.5, 0.25, 120.0, 30.0]
        return 4.0, dict(zip([key for pair in BIASES for key in pair], numbers, strict=True))

    found = measured([learnt(3.0), learnt(12.0), (4.0, {}), learnt(float("nan"))])
    assert gnss_to_json(found)["learnt"]["gnss_map_east_m"] == 12.0
    rows = dict(gnss_rows(found))
    assert rows["learnt displacement of the map"] == "12.0 +- 1.0 m east, -4.0 +- 1.0 m north"
    assert rows["learnt error of the mount"] == "0.50 +- 0.25 deg pitch, -0.50 +- 0.25 deg roll"
    assert rows["learnt latency"] == "120 +- 30 ms"
