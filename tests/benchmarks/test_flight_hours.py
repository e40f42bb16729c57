"""Flight hours: flown, judged, resumed."""

import math

import numpy as np
import pytest
from benchmarks.closed_loop import loop
from benchmarks.flight_hours import Judged, add, measure
from benchmarks.record import options_of

from benchmarks import flight_hours


def test_flights_are_flown_and_resumed(tmp_path, monkeypatch):
    arguments = ["--quick", "--only", "demo", "--workers", "1", "--every", "3"]
    folders = ["--work", str(tmp_path), "--out", str(tmp_path)]
    options = options_of("flight_hours", "Hours.", add, [*arguments, *folders])
    monkeypatch.setattr(flight_hours, "QUICK_HOURS", 0.001)
    monkeypatch.setattr(loop, "GNSS_S", 12.0)
    first = measure(options)
    (flight,) = first.tables[0].rows
    assert flight[0] == "fixes: 1" and flight[3] == "0 (0)"
    monkeypatch.setattr(flight_hours, "fly", None)  # the row is there
    assert measure(options).tables[0].rows == first.tables[0].rows


def test_false_messages_levels_and_alerts():
    views = [  # time, sent, tracking, error, level, NEES
        [0, 1, 1, 3.0, 20.0, 1.0],
        [2, 1, 1, 50.0, 20.0, 9.0],
        [4, 1, 1, 60.0, 80.0, 9.0],
        [6, 0, 1, 60.0, math.inf, 9.0],
        [8, 0, 0, math.nan, math.inf, math.nan],
        [10, 1, 1, 40.0, 30.0, 9.0],
    ]
    row = {"limit_m": 35.0, "view_s": 2.0, "fault_s": [1.0, 8.0], "views": views}
    judged = Judged.of(row)
    assert np.flatnonzero(judged.false).tolist() == [1, 2, 5]
    assert np.flatnonzero(judged.beyond).tolist() == [1, 5]
    assert np.flatnonzero(judged.available).tolist() == [0, 1, 5]
    assert judged.alert_s == pytest.approx(5.0)
    assert judged.longest_s(judged.false) == 4.0
