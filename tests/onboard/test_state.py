"""The state that is saved for a restart."""

import json
import math
from dataclasses import asdict, replace

import pytest

from orthonav.onboard import state
from orthonav.onboard.gnss.records import Displacement
from orthonav.onboard.state import SavedState, boot_id, displacements, load, prior_of, save

S = 10**9
SAVED = SavedState(48.1, 2.3, 4.0, 1_700_000_000 * S, 500 * S, "run-1", 77)


def test_a_saved_state_is_loaded(tmp_path, names_in):
    path = tmp_path / "state.json"
    assert load(path) is None
    for saved in (SAVED, replace(SAVED, lat_deg=-48.123456789)):
        save(path, saved)
        assert load(path) == saved
    assert names_in(tmp_path) == ["state.json"]


def test_the_age_does_not_depend_on_utc_within_one_boot():
    assert SAVED.age_s(0, 503 * S, "run-1") == 3.0
    assert SAVED.age_s(1_700_000_010 * S, 1 * S, "run-2") == 10.0
    assert SAVED.age_s(1_700_000_010 * S, 1 * S, "") == 10.0
    assert boot_id() == boot_id() != ""


def test_the_prior_grows_with_time():
    assert prior_of(SAVED, 0.0, 300.0).std_m == 4.0
    grown = prior_of(SAVED, 5.0, 300.0)
    assert (grown.lat_deg, grown.lon_deg) == (48.1, 2.3)
    assert grown.std_m == pytest.approx(math.hypot(4.0, 150.0))


@pytest.mark.parametrize("age_s", [301.0, -1.0, math.nan])
def test_old_or_future_states_are_not_used(age_s):
    assert prior_of(SAVED, age_s, 300.0) is None


def test_without_a_position_there_is_no_prior():
    assert prior_of(SavedState(signing_timestamp_10us=5), 1.0, 300.0) is None
    assert prior_of(replace(SAVED, std_m=math.nan), 1.0, 300.0) is None


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "{}", '{"version": 2}', '{"version": 1, "lat_deg": "x"}', "[" * 9999],
)
def test_a_damaged_file_is_ignored(tmp_path, text):
    path = tmp_path / "state.json"
    path.write_text(text)
    assert load(path) is None


def test_numbers_beyond_their_type_are_damage(tmp_path):
    path = tmp_path / "state.json"
    maps = {"a": {"east_m": 10**400, "north_m": 0, "std_m": 1, "agreed_s": 1}}
    save(path, SAVED)
    plain = json.loads(path.read_text())
    path.write_text(json.dumps({**plain, "utc_ns": math.inf, "maps": maps}))
    assert load(path) is None and displacements(path) == {}


def test_a_huge_file_is_ignored(tmp_path):
    path = tmp_path / "state.json"
    save(path, SAVED)
    plain = json.loads(path.read_text())
    path.write_text(json.dumps({**plain, "more": "x" * state.MAX_BYTES}))
    assert load(path) is None


def test_a_write_that_fails_leaves_the_old_one(tmp_path, monkeypatch, names_in):
    path = tmp_path / "state.json"
    save(path, SAVED)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(state.json, "dump", full)
    with pytest.raises(OSError, match="No space"):
        save(path, replace(SAVED, lat_deg=1.0))
    assert load(path) == SAVED and names_in(tmp_path) == ["state.json"]


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(OSError):
        save(tmp_path / "nowhere" / "state.json", SAVED)


def test_displacements_of_maps_are_saved_and_survive_without_the_witness(tmp_path):
    path = tmp_path / "state.json"
    learnt = Displacement(12.5, -3.25, 1.5, 3600.0)
    save(path, SAVED, {"digest": asdict(learnt), "other": asdict(replace(learnt, east_m=1.0))})
    save(path, replace(SAVED, lat_deg=1.0))  # a flight without --gnss keeps them
    assert load(path).lat_deg == 1.0
    found = displacements(path)
    assert found["digest"] == learnt and found["other"].east_m == 1.0


@pytest.mark.parametrize("maps", [3, [], {"a": 1}, {"a": {"east_m": "x"}}, {"a": {"std_m": 0}}])
def test_damaged_displacements_are_ignored(tmp_path, maps):
    path = tmp_path / "state.json"
    save(path, SAVED)
    path.write_text(json.dumps({**json.loads(path.read_text()), "maps": maps}))
    assert displacements(path) == {} and load(path) == SAVED
