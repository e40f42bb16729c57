"""The state that is saved for a restart."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.onboard import state
from orthonav.onboard.gnss.biases import unknown
from orthonav.onboard.state import SavedState, boot_id, learnt_biases, load, prior_of, save

S = 10**9
UTC_NS, MONO_NS = 1_700_000_000 * S, 500 * S
SAVED = SavedState(48.1, 2.3, 4.0, UTC_NS, MONO_NS, "run-1", 77)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state.json"


def test_a_saved_state_is_loaded(path, names_in):
    assert load(path) is None
    for saved in (SAVED, replace(SAVED, lat_deg=-48.123456789)):
        save(path, saved)
        assert load(path) == saved
    assert names_in(path.parent) == ["state.json"]


def test_the_age_does_not_depend_on_utc_within_one_boot():
    assert SAVED.age_s(0, 503 * S, "run-1") == 3.0
    assert SAVED.age_s(1_700_000_010 * S, 1 * S, "run-2") == 10.0
    assert SAVED.age_s(1_700_000_010 * S, 1 * S, "") == 10.0
    assert boot_id() == boot_id() != ""


def test_the_prior_grows_with_time():
    assert prior_of(SAVED, 0.0).std_m == 4.0
    grown = prior_of(SAVED, 5.0)
    assert (grown.lat_deg, grown.lon_deg) == (48.1, 2.3)
    assert grown.std_m == pytest.approx(math.hypot(4.0, 150.0))


@pytest.mark.parametrize("age_s", [301.0, -1.0, math.nan])
def test_old_or_future_states_are_not_used(age_s):
    assert prior_of(SAVED, age_s) is None


def test_without_a_position_there_is_no_prior():
    assert prior_of(SavedState(signing_timestamp_10us=5), 1.0) is None
    assert prior_of(replace(SAVED, std_m=math.nan), 1.0) is None


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "{}", '{"version": 2}', '{"version": 1, "lat_deg": "x"}', "[" * 9999],
)
def test_a_damaged_file_is_ignored(path, text):
    path.write_text(text)
    assert load(path) is None


@pytest.mark.parametrize(
    "more",
    [
        {"utc_ns": math.inf, "maps": {"a": {**unknown().to_plain(), "agreed_s": 10**400}}},
        {"more": "x" * state.MAX_BYTES},
    ],
    ids=["numbers beyond their type", "huge"],
)
def test_a_file_with_damaged_fields_is_ignored(path, more):
    save(path, SAVED)
    path.write_text(json.dumps({**json.loads(path.read_text()), **more}))
    assert load(path) is None and learnt_biases(path) == {}


def test_a_write_that_fails_leaves_the_old_one(path, monkeypatch, names_in):
    save(path, SAVED)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(state.json, "dump", full)
    with pytest.raises(OSError, match="No space"):
        save(path, replace(SAVED, lat_deg=1.0))
    assert load(path) == SAVED and names_in(path.parent) == ["state.json"]


def test_what_was_learnt_of_maps_is_saved_and_survives_without_the_monitor(path):
    learnt = replace(unknown("camera"), mean=np.array([12.5, -3.25, 0.01, -0.02, 0.125]))
    cov = (learnt.cov + np.outer(learnt.stds, learnt.stds)) / 3
    learnt = replace(learnt, cov=cov, agreed_s=3600.0)
    save(path, SAVED, {"digest": learnt.to_plain(), "other": unknown().to_plain()})
    save(path, replace(SAVED, lat_deg=1.0))  # a flight without --gnss keeps them
    assert load(path).lat_deg == 1.0
    found = learnt_biases(path)
    assert list(found) == ["digest", "other"]
    assert (found["digest"].agreed_s, found["digest"].setup) == (3600.0, "camera")
    assert np.array_equal(found["digest"].mean, learnt.mean)
    assert np.array_equal(found["digest"].cov, learnt.cov)


def test_what_was_learnt_of_many_maps_fits_into_the_file(path):
    third = replace(unknown("0" * 16), mean=np.full(5, 1 / 30), cov=unknown().cov / 3)
    save(path, SAVED, {f"{number:064d}": third.to_plain() for number in range(105)})
    assert len(learnt_biases(path)) == 100 and load(path) == SAVED


GOOD = unknown().to_plain()


@pytest.mark.parametrize(
    "wrong",
    [
        3,
        {},
        {**GOOD, "mean": [0.0] * 4},
        {**GOOD, "mean": [101.0, 0, 0, 0, 0]},
        {**GOOD, "mean": [0, 0, 0, 0, math.nan]},
        {**GOOD, "mean": [0, 0, 1.0, 0, 0]},
        {**GOOD, "mean": "none"},
        {**GOOD, "cov": GOOD["cov"][:-1]},
        {**GOOD, "cov": [0.0] * 15},
        {**GOOD, "cov": [-each for each in GOOD["cov"]]},
        {**GOOD, "cov": [1e9 * each for each in GOOD["cov"]]},
        {**GOOD, "cov": [math.inf] * 15},
        {**GOOD, "cov": [each or 1e6 for each in GOOD["cov"]]},
        {**GOOD, "agreed_s": -1},
        {**GOOD, "setup": 7},
        {"east_m": 1.0, "north_m": 2.0, "std_m": 3.0, "agreed_s": 4.0},
    ],
)
def test_damaged_or_impossible_biases_are_ignored(path, wrong):
    save(path, SAVED, {"wrong": wrong, "good": GOOD})
    assert list(learnt_biases(path)) == ["good"] and load(path) == SAVED


@pytest.mark.parametrize("maps", [3, []])
def test_damaged_maps_are_ignored(path, maps):
    save(path, SAVED)
    path.write_text(json.dumps({**json.loads(path.read_text()), "maps": maps}))
    assert learnt_biases(path) == {} and load(path) == SAVED
