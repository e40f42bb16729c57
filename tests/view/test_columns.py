"""GNSS and protection levels of views as columns of the page."""

from dataclasses import replace
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
from small_run import COV_EN_M2, FRAME, GSD_M, NORTH_M, WEST_M

from orthonav.core.flight.gnss import FAULTS
from orthonav.core.records import Fix, ViewResult
from orthonav.ground.view.run import columns_of

SHEET = SimpleNamespace(
    frame=FRAME, px_from_en=lambda en_m: (np.asarray(en_m) - [WEST_M, NORTH_M]) * [1, -1] / GSD_M
)


def view(number, gnss_en_m, fault):
    lat, lon = FRAME.latlon_from_en([0.0, 0.0])
    evidence = {"gnss_fault": fault}
    if gnss_en_m is not None:
        place = FRAME.latlon_from_en(gnss_en_m)
        evidence |= {"gnss_lat_deg": float(place[0]), "gnss_lon_deg": float(place[1])}
    fix = Fix(float(lat), float(lon), COV_EN_M2, 0.95, 35.0, 0.0, 60.0, MappingProxyType(evidence))
    return ViewResult(f"{number}", number * 10**9, fix, 1.0, "tracking")


def test_the_protection_level_is_that_of_the_risk_of_the_run():
    sure = view(0, None, 0.0)
    sure = replace(sure, outcome=replace(sure.outcome, place_probability=0.9999), risk=0.01)
    columns = columns_of([sure, view(1, None, 0.0)], {}, SHEET, 15.0)
    level_m = sure.outcome.protection_level_m(0.01)
    assert columns["level"] == [pytest.approx(level_m, abs=0.1), None]  # none at 0.95
    assert columns["risk"] == [0.01, 1e-3]


def test_gnss_is_shown_beside_the_fix():
    drift = float(FAULTS.index("gnss_drift") + 1)
    results = [view(0, (3.0, 4.0), 0.0), view(1, (30.0, 40.0), drift), view(2, None, 0.0)]
    at = FRAME.latlon_from_en([0.0, 4.0])
    truth = {"0": (float(at[0]), float(at[1]))}
    columns = columns_of(results, truth, SHEET, 15.0)
    assert columns["gdiff"] == [5.0, 50.0, None]
    assert columns["gerr"] == [3.0, None, None]
    assert columns["gfault"] == ["", "gnss_drift", ""]
    assert columns["gx"][0] == pytest.approx((3.0 - WEST_M) / GSD_M, abs=0.02)
    assert columns["gy"][0] == pytest.approx((NORTH_M - 4.0) / GSD_M, abs=0.02)
