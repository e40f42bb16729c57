"""Tiles equal their part of the sheet."""

import numpy as np
import pytest

from orthonav.research.tiles import SheetTiles, epoch_batches

TILE_PX = 32


def sheet(channels=1, **changes):
    rng = np.random.default_rng(0)
    parts = {
        "pixels": rng.integers(0, 256, (channels, 80, 96), dtype=np.uint8),
        "valid": rng.random((80, 96)) > 0.2,
        "tiles_px": np.array([[0, 0], [48, 64], [7, 9]]),
        "tile_px": TILE_PX,
    }
    return SheetTiles(**{**parts, **changes})


@pytest.mark.parametrize("channels", [1, 3])
def test_a_tile_equals_its_part_of_the_sheet_and_is_zero_where_invalid(channels):
    tiles = sheet(channels)
    maps = tiles.batch(np.array([2, 1]))
    assert maps.dtype == np.float32
    assert maps.shape == (2, channels, TILE_PX, TILE_PX)
    for made, (row, col) in zip(maps, [(7, 9), (48, 64)], strict=True):
        part = np.s_[row : row + TILE_PX, col : col + TILE_PX]
        wanted = tiles.pixels[:, *part] / 255 * tiles.valid[part]
        np.testing.assert_allclose(made, wanted, atol=1e-7)


def test_grey_levels_of_a_tile():
    grey = np.arange(80 * 96, dtype=np.uint32).astype(np.uint8).reshape(80, 96)
    tiles = sheet(grey=grey)
    np.testing.assert_array_equal(tiles.grey_tile(2), grey[7:39, 9:41])
    np.testing.assert_array_equal(sheet().grey_tile(2), sheet().pixels[0, 7:39, 9:41])
    tiles.grey_tile(2)[:] = 0
    assert tiles.grey_tile(2).any(), "a copy must be given"


@pytest.mark.parametrize("count, batch", [(25, 8), (3, 8), (64, 32), (1, 1)])
def test_batches_hold_every_tile_once_in_random_order(count, batch):
    plan = epoch_batches(count, batch, 0, 4)
    assert all(min(2, batch) <= len(part) <= batch for part in plan)
    together = np.concatenate(plan)
    np.testing.assert_array_equal(np.sort(together), np.arange(count))
    assert count == 1 or not np.array_equal(together, np.arange(count))
