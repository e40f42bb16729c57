"""The whitened embedding: a view of a tile gives what the tile gave, however it came in."""

import numpy as np
import pytest

from helpers import textured
from orthonav.core.errors import UsageError
from orthonav.core.tiles import represent
from orthonav.core.tiles.whitened import MICRO, CellLayout, CellSheet, WhitenedRecipe
from orthonav.core.variants import make_variant
from orthonav.ground.build.whitening import learn

TILE_PX = 128
SHEET_PX = 384
SHEET = (SHEET_PX, SHEET_PX)


def maps_of(grey, valid=None, name="gradient"):
    valid = np.ones(grey.shape, bool) if valid is None else valid
    return make_variant(represent.TABLE, name)(grey, valid)


def sheet_of(maps, valid, stride_px):
    layout = CellLayout.for_tiles(TILE_PX, stride_px)
    sheet = CellSheet(layout, *maps.shape[1:], len(maps))
    sheet.fill(0, 0, maps, valid)
    return sheet


def grid_px(stride_px, count=5):
    """First pixels (N, 2) of `count` x `count` tiles around the middle of the sheet."""
    first = (SHEET_PX - TILE_PX) // 2 // stride_px - count // 2
    along = np.clip(first + np.arange(count), 0, (SHEET_PX - TILE_PX) // stride_px) * stride_px
    rows, cols = np.meshgrid(np.unique(along), np.unique(along), indexing="ij")
    return np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)


class Place:
    """A sheet whose every part is imagery, and an embedder learnt on it."""

    def __init__(self, name="gradient", cells=8, dims=48, seed=0):
        self.maps = maps_of(textured(SHEET, seed), name=name)
        self.valid = np.ones((SHEET_PX, SHEET_PX), bool)
        self.sheet = sheet_of(self.maps, self.valid, 16)
        self.tiles_px = grid_px(16, 17)
        self.embedder = learn(WhitenedRecipe(cells=cells, dims=dims), self.sheet, self.tiles_px)

    def cut(self, row, col):
        part = np.s_[row : row + TILE_PX, col : col + TILE_PX]
        return self.maps[:, part[0], part[1]], self.valid[part]


@pytest.fixture(scope="module")
def place():
    return Place()


@pytest.fixture(
    scope="module", params=[("gradient", 8), ("gradient", 16), ("gray", 16), ("canny", 16)], ids=str
)
def any_place(request):
    return Place(*request.param)


def test_a_view_that_equals_a_tile_gives_its_embedding(any_place):
    stored = any_place.embedder.tiles(any_place.sheet, any_place.tiles_px)
    for row in (0, 40, len(stored) - 1):
        seen = any_place.embedder.view(*any_place.cut(*any_place.tiles_px[row]))
        np.testing.assert_allclose(seen, stored[row], atol=2e-3)
        assert int((stored.astype(np.float32) @ seen).argmax()) == row


@pytest.mark.parametrize("stride_px", [12, 1])
def test_the_stride_does_not_matter_where_imagery_is_missing(place, stride_px):
    valid = place.valid.copy()
    valid[150:, 170:] = False
    maps = maps_of(textured(SHEET), valid)
    sheet, tiles_px = sheet_of(maps, valid, stride_px), grid_px(stride_px)
    together = place.embedder.tiles(sheet, tiles_px)
    shares = sheet.valid_share(tiles_px)
    for tile_px, embedding, share in zip(tiles_px, together, shares, strict=True):
        part = np.s_[tile_px[0] : tile_px[0] + TILE_PX, tile_px[1] : tile_px[1] + TILE_PX]
        single = sheet_of(maps[:, part[0], part[1]], valid[part], TILE_PX)
        alone = place.embedder.tiles(single, np.zeros((1, 2), np.intp))[0]
        np.testing.assert_allclose(embedding, alone, atol=2e-3)
        assert share == pytest.approx(valid[part].mean(), abs=1e-6)


@pytest.mark.parametrize("stride_px", [16, 12, 6, 1])
@pytest.mark.parametrize("block_px", [64, 100, 384])
def test_filling_block_by_block_equals_filling_at_once(place, stride_px, block_px):
    valid = place.valid.copy()
    valid[100:180, 60:333] = False
    maps = place.maps * valid
    layout = CellLayout.for_tiles(TILE_PX, stride_px)
    whole = sheet_of(maps, valid, stride_px)
    blocks = CellSheet(layout, SHEET_PX, SHEET_PX, len(maps))
    end = layout.micro_px - layout.spacing_px
    for row in range(0, SHEET_PX, block_px):
        for col in range(0, SHEET_PX, block_px):
            part = np.s_[row : row + block_px + end, col : col + block_px + end]
            blocks.fill(row, col, maps[:, part[0], part[1]], valid[part])
    np.testing.assert_allclose(blocks.means, whole.means, atol=1e-3)
    np.testing.assert_allclose(blocks.valid, whole.valid, atol=1e-6)


@pytest.mark.parametrize("hidden", [0.1, 0.3, 0.5])
def test_part_of_a_view_still_finds_its_tile(place, hidden):
    stored = place.embedder.tiles(place.sheet, place.tiles_px).astype(np.float32)
    side = round(TILE_PX * hidden)
    for number, hide in enumerate((np.s_[:side, :], np.s_[:, -side:])):
        row = 60 + number
        maps, valid = (array.copy() for array in place.cut(*place.tiles_px[row]))
        valid[hide] = False
        seen = place.embedder.view(maps * valid, valid)
        scores = stored @ seen
        assert scores.argmax() == row and np.linalg.norm(seen) == pytest.approx(1, abs=1e-5)


def test_what_is_hidden_does_not_matter(place):
    valid = np.ones((TILE_PX, TILE_PX), bool)
    valid[30:, 90:] = False
    grey = textured(SHEET)[:TILE_PX, :TILE_PX]
    painted = np.where(valid, grey, textured(SHEET, 1)[:TILE_PX, :TILE_PX])
    seen = [place.embedder.view(maps_of(one, valid), valid) for one in (grey, painted)]
    np.testing.assert_array_equal(*seen)


def test_nothing_to_see_is_zero(place):
    maps = np.zeros_like(place.cut(0, 0)[0])
    nothing = np.zeros(maps.shape[1:], bool)
    assert not place.embedder.view(maps, nothing).any()
    empty = sheet_of(maps, nothing, TILE_PX)
    stored = place.embedder.tiles(empty, np.zeros((1, 2), np.intp))
    assert np.isfinite(stored).all() and not stored.any()


@pytest.mark.parametrize("shape", [(7, 128, 96), (7, 100, 100), (7, 33, 33)])
def test_views_of_another_shape_are_refused(place, shape):
    with pytest.raises(ValueError, match=f"square, a multiple of {MICRO}"):
        place.embedder.view(np.zeros(shape, np.float32), np.ones(shape[1:], bool))


@pytest.mark.parametrize("tile_px", [16, 100, 127])
def test_tiles_that_cannot_be_divided_are_refused(tile_px):
    with pytest.raises(UsageError, match=f"multiple of {MICRO}"):
        CellLayout.for_tiles(tile_px, 16)
