"""Flight hours: false messages, protection levels and alerts are counted."""

import math

import numpy as np
import pytest
from benchmarks.flight_hours import Judged


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
