"""GNSS beside the map: errors, differences and alarms, in figures, JSON and report."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from orthonav.core.flight.gnss import BIASES, FAULTS
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.evaluate.metrics import compare
from orthonav.ground.evaluate.tables import gnss_rows, gnss_to_json
from orthonav.ground.evaluate.track import measure_gnss

FRAME = LocalFrame(48.0, 2.0)
STEP = float(FAULTS.index("gnss_step") + 1)


def result(number, gnss_m=None, fault=0.0, found=True):
    """A view on a flight to the east at 10 m a view; the fix is 3 m off to the north."""
    evidence = {"gnss_fault": fault}
    if gnss_m is not None:
        lat, lon = FRAME.latlon_from_en([10.0 * number + gnss_m, 0.0])
        evidence |= {"gnss_lat_deg": float(lat), "gnss_lon_deg": float(lon)}
    lat, lon = FRAME.latlon_from_en([10.0 * number, 3.0])
    fix = Fix(float(lat), float(lon), np.eye(2), 0.99, 35.0, 0.0, 100.0, MappingProxyType(evidence))
    outcome = fix if found else NoFix("blank", "nothing", MappingProxyType(evidence))
    return ViewResult(f"{number}", number * 10**9, outcome, 5.0, "tracking")


def truth(count):
    lat, lon = FRAME.latlon_from_en(np.stack([10.0 * np.arange(count), np.zeros(count)], axis=1))
    return {f"{i}": (float(lat[i]), float(lon[i])) for i in range(count)}


RESULTS = [
    *(result(i, 4.0) for i in range(5)),
    *(result(i, 40.0, STEP) for i in range(5, 8)),
    result(8, None),
    result(9, 4.0, found=False),
]


def test_errors_differences_and_alarms_are_measured():
    without = [result(i) for i in range(3)]
    assert measure_gnss(compare(truth(3), without, FRAME), without) is None
    found = measure_gnss(compare(truth(10), RESULTS, FRAME), RESULTS)
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
    def learnt(number, east_m):
        keys = [key for pair in BIASES for key in pair]
        numbers = [east_m, 1.0, -4.0, 1.0, 0.5, 0.25, -0.5, 0.25, 120.0, 30.0]
        values = dict(zip(keys, numbers, strict=True))
        before = result(number, 4.0)
        evidence = MappingProxyType({**before.outcome.evidence, **values})
        return replace(before, outcome=replace(before.outcome, evidence=evidence))

    results = [learnt(0, 3.0), learnt(1, 12.0), result(2, 4.0), learnt(3, float("nan"))]
    found = measure_gnss(compare(truth(4), results, FRAME), results)
    assert gnss_to_json(found)["learnt"]["gnss_map_east_m"] == 12.0
    rows = dict(gnss_rows(found))
    assert rows["learnt displacement of the map"] == "12.0 +- 1.0 m east, -4.0 +- 1.0 m north"
    assert rows["learnt error of the mount"] == "0.50 +- 0.25 deg pitch, -0.50 +- 0.25 deg roll"
    assert rows["learnt latency"] == "120 +- 30 ms"
