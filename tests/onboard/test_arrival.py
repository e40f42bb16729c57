"""Gaps in the arrival of images, and timestamps of streams."""

import math

import numpy as np
import pytest
from fake_autopilot import S

from orthonav.onboard.arrival import ArrivalWatch


def arrivals(times_s, stamps_s=None):
    watch = ArrivalWatch()
    watch.opened()
    stamps_s = [math.nan] * len(times_s) if stamps_s is None else stamps_s
    return [
        watch.arrived(round(at * S), stamp) for at, stamp in zip(times_s, stamps_s, strict=True)
    ]


def test_a_steady_stream_does_not_change():
    jitter = np.random.default_rng(0).uniform(0, 0.1, 300)
    assert {each.changes for each in arrivals(np.arange(300) * 0.1 + jitter)} == {0}


def test_a_gap_is_a_change():
    found = arrivals([*np.arange(50) * 0.1, *(7.0 + np.arange(50) * 0.1)])
    assert [each.changes for each in found] == [0] * 50 + [1] * 50
    assert found[-1].why == "no image for 2.1 s"


def test_a_slow_camera_has_no_gaps():
    assert {each.changes for each in arrivals(np.arange(40) * 1.0)} == {0}


def test_a_camera_that_is_opened_again_is_a_change():
    watch = ArrivalWatch()
    watch.opened()
    assert watch.arrived(S, math.nan).changes == 0
    watch.opened()
    assert watch.arrived(2 * S, math.nan).changes == 1


def test_valid_timestamps_show_growth():
    stamps = np.arange(400) * 0.1
    late = np.where(stamps < 20, 0.1, 1.3)
    found = arrivals(stamps + late + 5, stamps)
    assert math.isnan(found[50].grown_s) and found[199].grown_s == pytest.approx(0, abs=0.01)
    assert all(each.grown_s == pytest.approx(1.2, abs=0.01) for each in found[200:])
    assert found[-1].changes == 0


def test_a_gap_that_is_caught_up_is_no_growth():
    stamps = np.arange(400) * 0.1
    times = stamps + 5.1
    times[200:220] = times[220]
    found = arrivals(np.maximum.accumulate(times + np.arange(400) * 1e-4), stamps)
    assert found[199].grown_s == pytest.approx(0, abs=0.05)
    assert found[201].grown_s > 1.0 and found[240].grown_s == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("rate", [0.4, 0.99, 1.01])
def test_timestamps_at_a_nominal_rate_are_ignored(rate):
    times = np.arange(600) * 0.1
    assert all(math.isnan(each.grown_s) for each in arrivals(times + 5, times * rate + 1))


def test_timestamps_that_stand_still_are_ignored():
    found = arrivals(np.arange(300) * 0.1, [3.0] * 300)
    assert all(math.isnan(each.grown_s) and each.changes == 0 for each in found)


def test_timestamps_that_jump_back_are_a_change():
    stamps = np.arange(400) * 0.1
    found = arrivals(stamps + 5, np.where(stamps < 20, stamps + 100, stamps))
    assert [found[i].changes for i in (199, 200, 399)] == [0, 1, 1]
