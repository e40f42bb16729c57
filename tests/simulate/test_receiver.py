"""Simulated GNSS receivers: a good one errs as stated, each fault begins when it should."""

import numpy as np
import pytest
from simulated import route_of, write_route

from orthonav.core.errors import UsageError, VariantError
from orthonav.core.flight.gnss import read_gnss
from orthonav.ground.simulate.receiver import RATE_HZ, receiver_of, solutions

TIMES = np.arange(0.0, 301.0)
PLACES = np.stack([20.0 * TIMES, 0.0 * TIMES], axis=1)


def solved(text, seed=0):
    return solutions(receiver_of(text), TIMES, PLACES, np.random.default_rng(seed))


def off(text):
    return solved(text).en_m - solved("good").en_m


def test_a_good_receiver_is_a_few_metres_off():
    errors = []
    for seed in range(20):
        made = solved("good:std_m=3", seed)
        true = np.stack([20.0 * made.times_s, 0.0 * made.times_s], axis=1)
        errors.append(made.en_m - true)
    assert 2.0 < np.std(errors) < 5.0
    assert len(made.times_s) == 300 * RATE_HZ + 1
    assert np.hypot(*(made.vel_en_mps - [20.0, 0.0]).T).max() < 1.0


def test_faults_begin_in_time():
    times = solved("good").times_s
    begun = times >= 100
    step = off("step:at_s=100,metres=30,bearing_deg=0")
    assert np.allclose(step, begun[:, None] * [0.0, 30.0])
    drag = off("drag:at_s=100,mps=2")
    assert np.allclose(drag[:, 0], 2 * np.maximum(times - 100, 0))
    assert np.allclose(solved("drag:at_s=100,mps=2").vel_en_mps[-1, 0], 22, atol=1)
    assert np.allclose(solved("drift:at_s=100").vel_en_mps, solved("good").vel_en_mps)
    smooth = off("step:at_s=100,metres=30,over_s=3")
    assert np.abs(np.diff(smooth, axis=0)).max() < 3 and np.allclose(smooth[-1], [30, 0])
    frozen = solved("frozen:at_s=100,stale=1")
    assert (np.diff(frozen.en_m[begun], axis=0) == 0).all()
    assert (np.diff(frozen.solved_s[begun]) == 0).all() and np.ptp(frozen.times_s) == 300
    jam = solved("jam:at_s=100,for_s=20")
    assert {*jam.fix_type[(times >= 100) & (times < 120)]} == {1} and jam.fix_type[-1] == 3
    assert len(solved("jam:at_s=100,for_s=20,silent=1").times_s) == len(times) - 20 * RATE_HZ
    jumping = np.hypot(*off("jumping:at_s=100,metres=40,every_s=5").T)
    assert {*np.round(jumping[begun])} == {0.0, 40.0}


def test_invalid_receivers_are_refused():
    with pytest.raises(VariantError, match="unknown variant 'broken'"):
        receiver_of("broken")
    with pytest.raises(UsageError, match="metres must be 0 to"):
        receiver_of("step:metres=-1")


def test_a_simulated_flight_has_solutions(ortho, frame, tmp_path, run):
    route = write_route(tmp_path / "route.csv", route_of(frame, [-100.0, 0.0], [100.0, 0.0]))
    flown = "simulate", "--ortho", ortho, "--agl-m", 100, "--out", tmp_path / "flight"
    done = run(*flown, "--route", route, "--receiver", "jam:at_s=5")
    assert done.code == 0, done.err
    samples = read_gnss(tmp_path / "flight" / "gnss.csv")
    assert {each.has_fix for each in samples if each.arrived_ns < 5e9} == {True}
    assert {each.has_fix for each in samples if each.arrived_ns >= 5e9} == {False}
    done = run(*flown, "--random", 2, "--receiver", "good")
    assert done.code == 2 and "gnss: only along a route" in done.err
