"""What cutting is made of: pooled confidences, and planes that are turned against each other."""

import math

import numpy as np
import pytest

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import Chances, LogisticConfidence, RegisteredConfidence
from orthonav.core.tiles.gradients import OrientedGradients
from orthonav.ground.atlas.cut import pooled_registered, pooled_tiles
from orthonav.ground.atlas.warp import Warp, _turn
from orthonav.ground.build.sheet import Block

TILES = [LogisticConfidence(-6.2, (11.0, 12.0)), LogisticConfidence(-4.2, (5.6, 21.7))]
REGISTERED = [
    RegisteredConfidence.usual(Chances(40.0, 18.0, 54.0)),
    RegisteredConfidence.usual(Chances(49.0, 17.0, 60.0)),
]
SHARES = [0.3, 0.7]


def test_one_sheet_keeps_its_confidence():
    assert pooled_tiles(TILES[:1], [1.0], 1.0) == TILES[0]
    assert pooled_registered(REGISTERED[:1]) == REGISTERED[0]
    alike = pooled_tiles([TILES[0]] * 3, [0.2, 0.5, 0.3], 0.5)
    assert alike.bias == pytest.approx(TILES[0].bias, abs=1e-9)
    assert alike.weights == pytest.approx(TILES[0].weights)


def test_the_confidence_of_tiles_never_exceeds_the_mean_of_the_sheets():
    pooled = pooled_tiles(TILES, SHARES, 1.0)
    for score in np.linspace(0.1, 1, 10):
        for margin in np.linspace(0, min(score, 0.5), 9):
            evidence = {"score": score, "margin": margin}
            mean = np.average([each(evidence) for each in TILES], weights=SHARES)
            if 0.55 < mean < 0.985:
                assert pooled(evidence) <= mean + 0.02
    assert pooled({"score": 0.9, "margin": 0.3}) > 0.9


def test_more_tiles_lower_the_odds():
    same, more = (pooled_tiles(TILES, SHARES, times) for times in (1.0, 4.0))
    assert same.bias - more.bias == pytest.approx(math.log(4))
    assert pooled_tiles(TILES, SHARES, 0.25) == same


@pytest.mark.parametrize("angle_deg", [-3.0, 0.5, 10.0])
def test_harmonics_rotate_with_the_plane(angle_deg):
    """Stripes, and stripes as a plane turned by an angle has them."""
    rows, cols = np.mgrid[:96, :96] - 47.5
    valid = np.ones(rows.shape, bool)

    def means(turned_deg):
        at = math.radians(30 + turned_deg)
        stripes = 128 + 60 * np.sin((cols * math.cos(at) + rows * math.sin(at)) / 5)
        maps = OrientedGradients()(np.rint(stripes).astype(np.uint8), valid)
        return maps[:, 16:-16, 16:-16].mean(axis=(1, 2))

    there = means(angle_deg)[None, None].copy()
    _turn(there, math.radians(angle_deg))
    assert np.abs(there[0, 0] - means(0)).max() < 0.02 * means(0)[0]


def test_the_affine_agrees_with_the_geodesy():
    """To a fiftieth of a pixel, within a kilometre, between planes 25 km apart."""

    class Sheet:
        frame = LocalFrame(60.0, 10.4)
        grid = TileGrid(-5000.0, 5000.0, 1.0, 256, 32, 300, 300)
        bounds_deg = (10.3, 59.95, 10.5, 60.05)

    frame, grid = LocalFrame(60.02, 10.0), TileGrid(18000.0, 3000.0, 1.0, 256, 32, 300, 300)
    block = Block(1024, 2048, 1024, 1024)
    warp = Warp(Sheet, frame, grid, True)
    assert warp.reaches(block) and not warp.reaches(Block(1024, 12_000, 1024, 1024))
    px = np.random.default_rng(0).uniform([2048, 1024], [3072, 2048], (50, 2))
    places = np.column_stack([grid.west_m + px[:, 0], grid.north_m - px[:, 1]])
    there = Sheet.frame.en_from_latlon(*frame.latlon_from_en(places))
    expected = np.column_stack([there[:, 0] + 5000, 5000 - there[:, 1]])
    affine = warp.affine(block)
    assert np.abs(px @ affine[:, :2].T + affine[:, 2] - expected).max() < 0.02
    assert math.degrees(math.atan2(affine[1, 0], affine[0, 0])) == pytest.approx(0.346, abs=0.02)
