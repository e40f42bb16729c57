"""Trial views are made and placed by the localizer that flies."""

import math
import multiprocessing
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.errors import MapFileError, WorkerError
from orthonav.core.geo.camera import Camera
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.check import trials
from orthonav.ground.check.records import CheckRequest, Conditions

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
WEST = np.array([[-250.0, 60.0], [-180.0, -90.0], [-300.0, 120.0], [-220.0, 0.0], [-330.0, -60.0]])
EAST = np.array([[200.0, 60.0], [250.0, -90.0], [300.0, 120.0]])


@pytest.fixture(scope="module")
def asked(half_blank):
    """Views of 154 x 115 m, searched in a part of the map."""
    return CheckRequest(half_blank.map, camera=CAMERA, prior_std_m=40.0, relief_m=0.0)


@pytest.fixture(scope="module")
def exact(asked, half_blank):
    """Views of the map's own orthophoto as it is, with exact telemetry."""
    return replace(asked, other_date=half_blank.past, yaw_std_deg=0.5, agl_std=0.0)


def run_trials(request, places, workers=1, **more):
    """Trials of the map's date and of the other, the places in two batches."""
    batches, found = [places[:3], places[3:]], ([], [])
    conditions = Conditions.of(request, 120.0, 35.0)
    for count, *both in trials.run_trials(request, conditions, batches, workers, **more):
        assert count >= max(map(len, both))
        for all_of, here in zip(found, both, strict=True):
            all_of += here
    return found


def plain(found):
    """What can be compared, NaN included."""
    return [[repr(trial) for trial in each] for each in found]


def test_unchanged_views_are_found_where_they_were_made(exact):
    found = run_trials(exact, WEST)[1]
    assert len(found) == len(WEST)
    for trial, place in zip(found, WEST, strict=True):
        assert math.dist(trial.en_m, place) < 0.75  # of whole pixels
        assert trial.error_m < 0.5 and trial.right
        assert math.isnan(trial.expected)


def test_places_off_the_map_are_left_out(asked):
    places = np.array([[-250.0, 60.0], [9e4, 0.0], [-1e7, 1e7], [0.0, 600.0]])
    found = run_trials(asked, places)[0]
    assert [math.dist(trial.en_m, places[0]) < 1 for trial in found] == [True]


@pytest.mark.long
def test_the_same_whatever_the_number_of_workers(asked, half_blank):
    """And of another date: what is beside a trial changes nothing."""
    both = replace(asked, other_date=half_blank.present)
    places = np.concatenate([WEST[:2], EAST[:1], [[9e4, 0]]])
    counts = []
    alone = run_trials(both, places)
    together = run_trials(both, places, 2, progress=counts.append)
    assert plain(alone) == plain(together) and len(alone[0]) == len(places) - 1
    assert counts == sorted(counts) and counts[-1] == len(places)
    assert len(counts) == 2 * len(places)
    assert plain(run_trials(asked, places[:2])) == plain([alone[0][:2], []])
    assert multiprocessing.active_children() == []


@pytest.mark.long
@pytest.mark.parametrize("how", ["killed", pytest.param("interrupted", marks=pytest.mark.slow)])
def test_workers_always_end(asked, how):
    def stop(_):
        if how == "interrupted":
            raise KeyboardInterrupt
        for child in multiprocessing.active_children():
            os.kill(child.pid, signal.SIGKILL)

    expected = {"killed": WorkerError, "interrupted": KeyboardInterrupt}[how]
    with pytest.raises(expected) as raised:
        run_trials(asked, np.tile(EAST, (16, 1)), 2, progress=stop)
    assert how != "killed" or "--workers" in str(raised.value)
    for _ in range(600):  # those that were killed are collected
        if not multiprocessing.active_children():
            break
        time.sleep(0.1)
    assert multiprocessing.active_children() == []


def test_a_map_without_registration(half_blank, tmp_path, monkeypatch):
    path = tmp_path / "tiles.onav"
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    build_map(BuildRequest([half_blank.past], path, tile_px=128, overlap=0.5, registration=False))
    with pytest.raises(MapFileError, match="registration layer"):
        run_trials(CheckRequest(path, camera=CAMERA), WEST[:1])
