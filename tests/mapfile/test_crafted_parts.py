"""Maps whose checksums are right and whose parts are not: the decoders themselves are reached."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.errors import MapFileError
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import GreyLayer, open_map, write_map
from orthonav.core.mapfile.layer import preview
from orthonav.core.records import NoFix, Telemetry, View
from orthonav.onboard.run import SingleViews, locate_view

GOLDEN = Path(__file__).parent.parent / "data" / "golden_v1.onav"
CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)


def golden():
    opened = open_map(GOLDEN)
    return opened.manifest, {name: np.array(part) for name, part in opened.arrays.items()}


def written(path, parts, **changes):
    """The golden map with other parts, its checksums right."""
    manifest, arrays = golden()
    write_map(path, replace(manifest, **changes), {**arrays, **parts})
    return path


def used(path):
    """Everything that reads a part of a map; only errors of ours are allowed."""
    opened = open_map(path)
    for read in (preview, everything_of_the_layer, located):
        try:
            read(opened)
        except MapFileError as error:
            assert "\n" not in str(error)


def everything_of_the_layer(opened):
    layer = GreyLayer.of(opened)
    for level in range(layer.levels if layer else 0):
        layer.read(level, 0, 0, *layer.shape(level))


def located(opened):
    grey = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    view = View(grey, CAMERA, Telemetry(0, 0.0, 0.0, 0.0, 250.0))
    outcome, _ = locate_view(SingleViews(Localizer(opened)), view)
    assert not isinstance(outcome, NoFix) or outcome.reason != "internal_error", outcome


def mutations(part, rng):
    """Variants of the values of a part, of the same type and number of dimensions."""
    flat = part.reshape(-1)
    for _ in range(2):
        changed = flat.copy()
        at = rng.integers(0, len(changed), 3)
        changed[at] = rng.integers(0, 256, 3).astype(part.dtype)
        yield changed.reshape(part.shape)
    if part.dtype == np.uint8:
        yield np.zeros_like(part)
        yield np.full_like(part, 255)
    elif part.dtype.kind == "f":
        for value in (np.nan, np.inf, 0.0, 6e4):
            yield np.full_like(part, value)
    else:
        for value in (-1, 0, 2**62, -(2**63)):
            yield np.full_like(part, value)
            changed = part.copy()
            changed[1] = value
            yield changed
    yield part[: len(part) // 2]
    yield part[:0]
    yield np.concatenate([part, part])


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(golden()[1]))
def test_any_values_of_a_part_give_our_errors(tmp_path, name, caplog):
    rng = np.random.default_rng(len(name))
    for changed in mutations(golden()[1][name], rng):
        used(written(tmp_path / "a.onav", {name: changed}))
    assert not any(record.exc_info for record in caplog.records)


def test_a_coarsest_level_of_gigapixels(tmp_path):
    """Its chunks are empty, so the file is small; programs read this level as a whole."""
    manifest, _ = golden()
    sheet = manifest.sheets[0]
    for rows, levels in ((600, 4), (250, 1), (600, 1)):
        grid = replace(sheet.grid, rows=rows, cols=2, stride_px=32, gsd_m=0.1)
        grey = replace(sheet.grey, levels=levels)
        path = written(
            tmp_path / "a.onav", {}, sheets=(replace(sheet, grid=grid, tiles=2, grey=grey),)
        )
        if (rows, levels) != (600, 1):
            open_map(path)
    with pytest.raises(MapFileError, match="impossible registration layer"):
        open_map(path)
