"""Means of cells as parts of a map: close to what they were, and refused where they do not fit."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from helpers import textured
from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.represent import OrientedGradients
from orthonav.core.tiles.whitened import CellSheet
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.layer import StoredCells, cell_parts

GRID = TileGrid(0.0, 0.0, 1.0, 128, 32, 6, 5)
LAYOUT = CellLayout(4, 4)


@pytest.fixture(scope="module")
def cells():
    """Cells of a picture of which a corner is not valid."""
    grey = textured((GRID.height_px, GRID.width_px))
    valid = np.ones(grey.shape, bool)
    valid[:50, :70] = False
    made = CellSheet(LAYOUT, *grey.shape, 7)
    made.fill(0, 0, OrientedGradients()(grey, valid), valid)
    return made


def opened(parts):
    manifest = SimpleNamespace(sheets=[SimpleNamespace(grid=GRID)])
    return MapFile(Path("a.onav"), 0, manifest, parts)


def stored(cells, **changes):
    parts = {**cell_parts(cells), **changes}
    found = StoredCells.of(opened(parts), LAYOUT, cells.means.shape[2])
    assert found is not None
    return found


def test_means_come_back_as_they_were(cells):
    means, share = stored(cells).read(0, 0, *cells.valid.shape)
    largest = np.abs(cells.means).max(axis=2, keepdims=True)
    assert (np.abs(means - cells.means) <= largest * 0.0045 + 1e-6).all()
    assert np.abs(share - cells.valid).max() <= 1 / 255
    assert ((share == 1) == (cells.valid == 1)).all() and (share[:10, :10] == 0).all()


def test_windows_may_reach_beyond_the_sheet(cells):
    found = stored(cells)
    rows, cols = cells.valid.shape
    means, share = found.read(rows - 3, -2, 8, 10)
    whole, _ = found.read(0, 0, rows, cols)
    assert np.array_equal(means[:3, 2:], whole[-3:, :8])
    assert not means[3:].any() and not share[3:].any() and not share[:, :2].any()
    for outside in ((-9, 0, 4, 4), (0, cols, 4, 4), (0, 0, 0, 0)):
        means, share = found.read(*outside)
        assert means.shape == (*outside[2:], 7) and not means.any() and not share.any()


@pytest.mark.parametrize("name", ["codes", "scale", "valid"])
def test_cells_that_are_not_those_of_the_grid_are_refused(cells, name):
    part = cell_parts(cells)[f"sheet0/cells/{name}"]
    for other in (part[:-1], part.astype(np.float32), part[0]):
        with pytest.raises(MapFileError, match="cells"):
            stored(cells, **{f"sheet0/cells/{name}": other})
    with pytest.raises(MapFileError, match="cells"):
        StoredCells.of(opened(cell_parts(cells)), LAYOUT, 3)


def test_maps_carry_cells_only_where_asked(make_ortho, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 4)
    ortho = make_ortho(tmp_path / "2019-06.tif", textured((200, 200)))
    made = {}
    for cells in (False, True):
        out = tmp_path / f"{cells}.onav"
        request = {"tile_px": 64, "overlap": 0.75, "registration": False}
        made[cells] = build_map(BuildRequest([ortho], out, cells=cells, **request)).manifest
    without, with_cells = (set(made[each].parts) for each in (False, True))
    assert {name.rpartition("/")[0] for name in with_cells - without} == {"sheet0/cells"}
    assert all(made[True].parts[name] == made[False].parts[name] for name in without)
