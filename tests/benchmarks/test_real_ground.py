"""The gate of real ground, and the relief that its views show."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from benchmarks.real_ground import gate, pairs
from benchmarks.real_ground.maps import COARSE_STD_M, coarse_of, fractal_relief
from benchmarks.real_ground.score import Placed, Row, Seen, compared

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Telemetry, View

KEPT = {"valley": {"views": 20, "median_m": 4.0, "of_right": 0.9, "exceeded": 1}}
FOUND = {"valley": {"median_m": 4.0, "of_right": 0.9, "exceeded": 1, "nees": 2.0, "false": 0}}


def failed(**changed):
    found = {"valley": FOUND["valley"] | changed}
    return [line[1] for line in gate.failures(KEPT, found)]


def test_equal_figures_pass():
    assert gate.failures(KEPT, FOUND) == []
    assert not gate.judged(KEPT, FOUND, []).failed


@pytest.mark.parametrize(
    ("changed", "figure"),
    [
        ({"median_m": 4.7}, "median m"),
        ({"nees": 3.6}, "NEES"),
        ({"nees": 0.09}, "NEES"),
        ({"exceeded": 2}, "protection levels exceeded"),
        ({"of_right": 0.7}, "confident of right"),
        ({"false": 1}, "false"),
        ({"median_m": None, "nees": None}, "confident fixes"),
    ],
)
def test_what_is_worse_fails_and_is_named(changed, figure):
    assert failed(**changed) == [figure]


def test_a_band_of_a_row_replaces_the_usual_one():
    kept = {"valley": KEPT["valley"] | {"nees": [0.1, 5.0]}}
    assert gate.failures(kept, {"valley": FOUND["valley"] | {"nees": 4.9}}) == []


def test_a_missing_row_fails():
    assert gate.failures(KEPT, {}) == [["valley", "row", "missing", "there"]]
    assert gate.judged(KEPT, {}, []).failed


def test_renewed_figures_keep_views_and_bands(tmp_path):
    kept = {"valley": {"views": 20, "nees": [0.1, 5.0]}, "suburb": {"views": 3}}
    gate.write(gate.renewed(kept, FOUND), tmp_path / "gate.json")
    made = json.loads((tmp_path / "gate.json").read_text())
    assert made["valley"] == {**kept["valley"], "median_m": 4.0, "of_right": 0.9, "exceeded": 1}
    assert made["suburb"] == {"views": 3}


def fix(time_s, error_m, state=None, confident=True):
    level_m = 30.0 if confident else np.inf
    return Placed(time_s, state, confident, error_m, False, 4.0, 2.0, level_m)


SINGLE = [fix(float(second), 1.0 + second / 10) for second in range(20)]
TRACK = [replace(each, state="tracking") for each in SINGLE]


def rows(single, track):
    """Values of both rows of a flight, as read from a file."""
    made = {"valley, single": single, "valley, tracked": track}
    values = {name: {"fixes": [asdict(each) for each in fixes]} for name, fixes in made.items()}
    return json.loads(json.dumps(values))


def worse(single, track):
    return [line[1] for line in pairs.failures(pairs.paired(rows(single, track)))]


def farther(fixes, factor):
    return [replace(each, error_m=each.error_m * factor) for each in fixes]


def test_a_track_as_good_as_its_single_views_passes():
    assert worse(SINGLE, TRACK) == []
    assert worse(SINGLE, farther(TRACK, 1.1)) == []  # by chance


def test_a_track_worse_than_its_single_views_fails():
    assert worse(SINGLE, farther(TRACK, 1.5)) == ["median m", "95 % m"]
    assert worse(SINGLE, TRACK[:-2] + farther(TRACK[-2:], 2.0)) == ["95 % m"]
    assert worse(SINGLE, []) == ["confident fixes"]
    found = gate.judged({}, rows(SINGLE, farther(TRACK, 1.5)), [])
    assert found.failed and found.tables[-1].rows[0][0] == "valley, tracked"


def test_only_views_where_both_are_confident_are_compared():
    hard = [fix(float(second), 9.0, "coasting") for second in range(20, 40)]
    assert worse(SINGLE, TRACK + hard) == []
    unsure = [replace(each, confident=False) for each in hard]
    assert worse(SINGLE + unsure, TRACK + hard) == []
    assert worse(SINGLE[:9], TRACK[:9] + hard) == ["median m", "95 % m"]  # too few of both


def test_a_row_without_its_counterpart_is_no_pair():
    values = rows(SINGLE, TRACK)
    del values["valley, single"]
    assert pairs.paired(values) == {}


@pytest.mark.parametrize("slope", [0.0, 0.02, 0.1])
def test_the_relief_has_its_slope(slope):
    made = fractal_relief((300, 450), 5.0, slope, 3)
    steep = np.sqrt(sum(np.mean(part**2) for part in np.gradient(made, 5.0)))
    assert made.shape == (300, 450)
    assert steep == pytest.approx(slope, rel=0.01, abs=1e-6)


def test_a_coarse_terrain_errs_by_its_deviation():
    flat = np.full((1500, 1500), 200.0, np.float32)
    error = coarse_of(flat, 2.0, 4) - 200.0
    assert error.shape == (100, 100)
    assert error.std() == pytest.approx(COARSE_STD_M, rel=0.2)
    # Correlated over 150 m, which are five postings.
    assert np.corrcoef(error[:, :-5].ravel(), error[:, 5:].ravel())[0, 1] == pytest.approx(
        np.exp(-1), abs=0.2
    )


def test_the_error_of_the_truth_is_part_of_the_nees():
    frame = LocalFrame(48.0, 2.0)
    lat, lon = (float(value) for value in frame.latlon_from_en(np.array([10.0, 0.0])))
    fix = Fix(lat, lon, np.eye(2) * 4.0, 0.95, 35.0, 0.0, 200.0)
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    view = View(np.zeros((48, 64), np.uint8), camera, Telemetry(0, 0.0, 0.0, 0.0, 200.0))
    exact, doubtful = (compared(fix, Seen(view, (48.0, 2.0), 200.0), frame, std) for std in (0, 4))
    assert exact[0].nees == pytest.approx(25.0, rel=1e-3)
    assert doubtful[0].nees == pytest.approx(5.0, rel=1e-3)
    assert Row(exact, [5.0]).values()["median_m"] == pytest.approx(10.0, rel=1e-3)
