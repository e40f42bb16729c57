"""A long run for tests of the page of `orthonav view`: many views without pictures."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthonav.core.flight.fixes import write_results
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult

SEED = 3
WRONG_SHARE, NO_FIX_SHARE, CHANGE_SHARE = 0.02, 0.05, 0.01


@dataclass(frozen=True)
class LongRun:
    """Paths of a run without pictures."""

    fixes: Path
    truth: Path


def write_long_run(
    folder: Path, count: int, frame: LocalFrame, middle_en_m: tuple[float, float], reach_m: float
) -> LongRun:
    """Looped flight, one view per second: most fixes correct, a few confident but wrong.

    `reach_m`: how far from the middle, in metres, the course goes.
    """
    rng = np.random.default_rng(SEED)
    angle = np.linspace(0.0, 2 * np.pi * count / 900, count)
    radius_m = reach_m * (0.7 + 0.3 * np.cos(angle / 5.3))
    truth_en_m = np.stack([radius_m * np.cos(angle), radius_m * np.sin(1.01 * angle)], axis=1)
    truth_en_m += middle_en_m
    far = rng.random(count) < WRONG_SHARE
    fixes_en_m = truth_en_m + rng.normal(0.0, np.where(far, 60.0, 3.0)[:, None], (count, 2))
    lat, lon = frame.latlon_from_en(fixes_en_m)
    states = ("searching", "tracking", "tracking", "lost")
    state = states[0]
    results = []
    for i in range(count):
        if rng.random() < CHANGE_SHARE:
            state = states[rng.integers(len(states))]
        outcome: Fix | NoFix = NoFix("blank", "there is nothing to see")
        if rng.random() >= NO_FIX_SHARE:
            size = rng.uniform(2.0, 8.0)
            cov = np.array([[size**2, 0.4 * size], [0.4 * size, 4.0]])
            confidence = float(rng.beta(9.0, 1.0))
            outcome = Fix(float(lat[i]), float(lon[i]), cov, confidence, 35.0, 40.0, 120.0, {})
        results.append(ViewResult(f"{i:06d}.jpg", (100 + i) * 10**9, outcome, 25.0, state))
    run = LongRun(folder / f"{count}.jsonl", folder / f"{count}.csv")
    write_results(run.fixes, results)
    true_lat, true_lon = frame.latlon_from_en(truth_en_m)
    with run.truth.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["frame", "lat_deg", "lon_deg"])
        for i in range(count):
            rows.writerow([f"{i:06d}.jpg", repr(float(true_lat[i])), repr(float(true_lon[i]))])
    return run
