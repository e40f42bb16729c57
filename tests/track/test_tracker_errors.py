"""Tracks of flights whose mount, horizon and velocity are not as reported, beside single views."""

import math

import blots
import numpy as np
import pytest
from blots import AGL_M, GROUND, rendered
from test_tracker import SPEED_MPS, WIDE, changed, followed, legs, place_of

from orthonav.core.records import CONFIDENT, Fix, Telemetry, View
from orthonav.core.track.tracker import UNAIDED_S, Tracker

EVERY_S = 1.0
MOUNT_DEG = np.array([1.6, -1.2])
HORIZON_DEG, HORIZON_S = 1.5, 15.0
WRONG_MPS, WRONG_S = 4.0, 10.0
DATES_M = 2.0


localizer = blots.known_localizer


class OtherDate:
    """The ground as another orthophoto has it: displaced by metres, alike within some 100 m."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        waves = rng.normal(0, 1, (2, 12, 2))
        lengths_m = rng.uniform(60.0, 200.0, (2, 12, 1))
        self.waves = waves / np.linalg.norm(waves, axis=-1, keepdims=True) * 2 * np.pi / lengths_m
        self.phases = rng.uniform(0, 2 * np.pi, (2, 12))

    def __call__(self, east, north):
        off_m = np.zeros((2, *np.shape(east)))
        for axis in range(2):
            for (x, y), phase in zip(self.waves[axis], self.phases[axis], strict=True):
                off_m[axis] += DATES_M * math.sqrt(2 / 12) * np.sin(x * east + y * north + phase)
        return GROUND(east + off_m[0], north + off_m[1])


def process(rng, std, correlation_s, count):
    """Values (count, 2) of a Gauss-Markov process."""
    left = math.exp(-EVERY_S / correlation_s)
    now, out = rng.normal(0, std, 2), []
    for _ in range(count):
        out.append(now)
        now = left * now + rng.normal(0, std * math.sqrt(1 - left**2), 2)
    return np.array(out)


def flown(seed, count=22):
    """Grey views, telemetry that knows nothing of its errors, and places."""
    rng, ground = np.random.default_rng(seed), OtherDate(seed)
    horizon = process(rng, HORIZON_DEG, HORIZON_S, count)
    wrong = process(rng, WRONG_MPS, WRONG_S, count)
    before = None
    for number, (place, heading) in enumerate(legs(count)):
        attitude = (heading, *(MOUNT_DEG + horizon[number]))
        grey = changed(rendered(ground, place, attitude, AGL_M, WIDE), rng)
        velocity = None if before is None else tuple((place - before) / EVERY_S + wrong[number])
        before = place
        yaw_deg = heading + rng.normal(0, 1.0)
        yield (
            grey,
            Telemetry(number * 10**9, yaw_deg, 0.0, 0.0, AGL_M, vel_en_mps=velocity),
            place,
        )


@pytest.mark.long
def test_a_track_is_no_worse_than_its_single_views(localizer):
    """Views that are as wrong as two dates of a map usually differ."""
    tracked, alone = [], []
    for seed in range(3):
        seen, tracker = list(flown(seed)), Tracker(localizer)
        rows = followed(tracker, localizer, seen)
        assert [row[2] for row in rows[12:]] == ["tracking"] * 10
        tracked += [row[0] for row in rows if row[2] == "tracking" and row[1] >= CONFIDENT]
        for grey, telemetry, place in seen:
            found = localizer.locate(View(grey, WIDE, telemetry))
            if isinstance(found, Fix) and found.confidence >= CONFIDENT:
                alone.append(float(np.hypot(*(place_of(localizer, found) - place))))
    assert len(tracked) > 30 and len(alone) > 30
    assert np.median(tracked) <= 1.15 * np.median(alone)
    assert max(tracked) < 15


@pytest.mark.parametrize("wrong", [False, True], ids=["right", "wrong"])
def test_errors_of_the_reported_velocity_are_learnt_from_odometry(localizer, wrong, monkeypatch):
    tracker, used_mps = Tracker(localizer), []
    predict = tracker.mixture.predict

    def noted(seconds, velocity=None, *others):
        used_mps.append((velocity.std_mps, velocity.correlation_s))
        return predict(seconds, velocity, *others)

    monkeypatch.setattr(tracker.mixture, "predict", noted)
    along = math.radians(60.0)
    moving = SPEED_MPS * np.array([math.sin(along), math.cos(along)])
    velocity = tuple(moving + np.array([6.0, -8.0]) * wrong)
    told = [
        (
            rendered(GROUND, place, (60.0, 0.0, 0.0), AGL_M, WIDE),
            Telemetry(number * 10**9, 60.0, 0.0, 0.0, AGL_M, vel_en_mps=velocity),
            place,
        )
        for number, (place, _) in enumerate(legs(12))
    ]
    followed(tracker, localizer, told)
    (first_mps, first_s), (last_mps, last_s) = used_mps[0], used_mps[-1]
    assert 3.0 < first_mps < 3.5 and first_s == last_s == UNAIDED_S
    if wrong:
        assert all(std > 5.0 for std, _ in used_mps[2:])
        assert 5.0 < last_mps < 12.0 and tracker.state_name == "tracking"
    else:
        assert last_mps == first_mps
