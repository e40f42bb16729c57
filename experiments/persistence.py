"""Learn what lasts from year to year on generated landscapes, for `orthonav check`.

`python -m experiments.persistence` renders landscapes of several seeds and resolutions at several
dates, compares the gradients of every ordered pair of dates patch by patch, and writes the
regression to `src/orthonav/ground/check/persistence.json`. Takes some five minutes. Seeds here are
used nowhere else, so that landscapes of others test it.
"""

import json
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lab.landscape import DEFAULT_DATES, ORIGIN_M, Landscape
from numpy.typing import NDArray

from orthonav.core.register.template import FINE, channels_of
from orthonav.ground.check.ageing import (
    PATCH_PX,
    PersistenceModel,
    features,
    terms,
)

Array = NDArray[Any]
SEEDS = (901, 902, 903, 904)
GSD_M = (0.25, 0.5, 1.0, 2.0, 4.0)
SIDE_PX = 1024
LEVELS = 2
RIDGE = 3e-3
OUT = Path(__file__).parents[1] / "src" / "orthonav" / "ground" / "check" / "persistence.json"


def main() -> None:
    """Fit the model, print how well it predicts a held-out seed, and write it."""
    samples = {seed: _samples(seed) for seed in SEEDS}
    held_out = []
    for seed in SEEDS:
        model = fitted([samples[each] for each in SEEDS if each != seed])
        predicted, found = model(samples[seed][0]), samples[seed][1]
        alike, bias = np.corrcoef(predicted, found)[0, 1], predicted.mean() - found.mean()
        held_out.append([float(alike), float(bias)])
        print(
            f"seed {seed} left out: correlation {held_out[-1][0]:.2f}, bias {held_out[-1][1]:+.3f}"
        )
    model = fitted(list(samples.values()))
    plain = {
        "made_by": "python -m experiments.persistence",
        "data": f"generated landscapes, seeds {SEEDS}, {GSD_M} m per pixel, {LEVELS} levels, "
        f"{SIDE_PX} px, all ordered pairs of {[date.name for date in DEFAULT_DATES]}",
        "patches": sum(len(found) for _, found in samples.values()),
        "left_out_correlation_and_bias": np.round(held_out, 3).tolist(),
        "model": model.to_plain(),
    }
    OUT.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


def _samples(seed: int) -> tuple[Array, Array]:
    """Features (N, F) of patches and the correlation (N,) of their gradients with another date."""
    landscape = Landscape(seed)
    patches, found = [], []
    for number, gsd_m in enumerate(GSD_M):
        west, north = ORIGIN_M[0] + 5000.0 * number, ORIGIN_M[1] + 9000.0
        pictures = [
            _grey(landscape.render(date, west, north, SIDE_PX, SIDE_PX, gsd_m))
            for date in DEFAULT_DATES
        ]
        print(f"seed {seed}, {gsd_m} m", flush=True)
        for level in range(LEVELS):
            if level:
                pictures = [_halved(each) for each in pictures]
            kinds = [features(each, gsd_m * 2**level, PATCH_PX) for each in pictures]
            gradients = [
                channels_of(each, np.ones(each.shape, np.bool_), FINE)[..., :2] for each in pictures
            ]
            for one, other in permutations(range(len(pictures)), 2):
                patches.append(kinds[one][1:-1, 1:-1].reshape(-1, kinds[one].shape[-1]))
                found.append(correlation(gradients[one], gradients[other])[1:-1, 1:-1].ravel())
    return np.concatenate(patches), np.concatenate(found)


def _grey(rgb: Array) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _halved(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    made = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(made, np.uint8)


def correlation(one: Array, other: Array) -> Array:
    """Correlation of gradients (H, W, 2) around every patch's middle."""

    def mean(values: Array) -> Array:
        half = PATCH_PX // 2
        blurred = cv2.blur(values.sum(axis=-1), (PATCH_PX, PATCH_PX))
        return np.asarray(blurred[half::PATCH_PX, half::PATCH_PX])

    power = np.maximum(mean(one * one), 1e-9) * np.maximum(mean(other * other), 1e-9)
    return np.asarray(mean(one * other) / np.sqrt(power))


def fitted(samples: list[tuple[Array, Array]]) -> PersistenceModel:
    """Least squares with a slight ridge."""
    patches = np.concatenate([each[0] for each in samples]).astype(np.float64)
    found = np.concatenate([each[1] for each in samples]).astype(np.float64)
    mean, spread = patches.mean(axis=0), patches.std(axis=0) + 1e-9
    rows = terms((patches - mean) / spread)
    ridge = RIDGE * len(rows) * np.eye(rows.shape[1])
    ridge[0, 0] = 0.0
    weights = np.linalg.solve(rows.T @ rows + ridge, rows.T @ found)
    return PersistenceModel(mean, spread, weights)


if __name__ == "__main__":
    main()
