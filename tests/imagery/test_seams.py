"""Many orthophotos that lie side by side are one picture: no seam shows where they meet."""

import numpy as np
import pytest
from geotiffs import FRAME, LAMBERT, placed, read, sheet_of, smooth_scene, write
from rasterio.transform import Affine

from orthonav.core.geo.frames import LocalFrame

BREST = LocalFrame(48.39, -4.49)  # Lambert-93 is turned by -5.4 degrees here


def rough_scene(size, seed=0):
    """Waves with noise on them (3, size, size): resampling shows at every pixel."""
    noise = np.random.default_rng(seed).integers(-40, 40, (3, size, size))
    return np.clip(smooth_scene(size) + noise, 1, 255).astype(np.uint8)


def cut(folder, scene, transform, side, make=write, **more):
    """The scene in files of `side` pixels, less where it ends."""
    folder.mkdir(exist_ok=True)
    paths = []
    for row in range(0, scene.shape[1], side):
        for col in range(0, scene.shape[2], side):
            part = np.ascontiguousarray(scene[:, row : row + side, col : col + side])
            here = transform * Affine.translation(col, row)
            paths.append(make(folder / f"{row:04}-{col:04}.tif", part, transform=here, **more))
    return paths


@pytest.mark.parametrize(
    "frame, source_gsd_m, gsd_m, side",
    [
        (FRAME, 1.0, 1.0, 50),
        (FRAME, 0.2, 1.0, 223),
        (BREST, 1.0, 1.0, 50),
        (BREST, 1.0, 1.7, 50),
        (BREST, 0.2, 1.0, 220),  # cells of 5 pixels end where the files do
        (BREST, 0.2, 0.5, 220),  # of 3 pixels they would not: 2 are taken
        (BREST, 0.2, 1.0, 223),  # nothing fits
        (BREST, 0.25, 1.3, 187),
    ],
)
def test_a_raster_cut_into_files_is_read_as_the_whole(tmp_path, frame, source_gsd_m, gsd_m, side):
    size = round(130 / source_gsd_m)
    transform = placed(LAMBERT, source_gsd_m, size, frame=frame)
    scene = rough_scene(size)
    whole = read(write(tmp_path / "whole.tif", scene, transform=transform), 90, gsd_m, frame)
    parts = read(cut(tmp_path / "cut", scene, transform, side), 90, gsd_m, frame)
    inner = np.s_[3:-3, 3:-3] if gsd_m * 90 > 125 else np.s_[:]
    np.testing.assert_array_equal(parts.valid[inner], whole.valid[inner])
    both = parts.valid & whole.valid
    off = np.abs(parts.rgb.astype(int) - whole.rgb)[both]
    alike = gsd_m not in (0.5, 0.6)  # averaged by 2 rather than 3
    assert off.mean() < (0.2 if alike else 5) and off.max() <= (3 if alike else 40)
    assert both.mean() > 0.65


@pytest.mark.parametrize("window, side", [((0, 0, 90, 90), 220), ((0, 40, 80, 9), 223)])
def test_holes_and_bit_depths_survive_the_seams(tmp_path, window, side):
    size = 650
    transform = placed(LAMBERT, 0.2, size, frame=BREST)
    scene = rough_scene(size).astype(np.uint16) * 200
    scene[:, 280:380, 250:420] = 0  # nodata, across several files
    whole = write(tmp_path / "whole.tif", scene, transform=transform, nodata=0)
    parts = cut(tmp_path / "cut", scene, transform, side, nodata=0)
    found = []
    for paths in (whole, parts):
        with sheet_of(paths, 90, 1.0, BREST) as sheet:
            found.append(sheet.read(*window))
    one, many = found
    assert (one.valid != many.valid).mean() < 0.01
    assert 0.5 < one.valid.mean() < 0.98
    off = np.abs(one.rgb.astype(int) - many.rgb)[one.valid & many.valid]
    assert off.mean() < 1.5  # files are not stretched alike: fewer pixels are sampled


@pytest.mark.parametrize("shift_px", [0.5, 0.25])
@pytest.mark.parametrize("frame", [FRAME, BREST], ids=["straight", "turned"])
def test_no_gap_between_files_that_share_no_lattice(tmp_path, frame, shift_px):
    """They meet, but on pixels of their own."""
    bands, base = np.full((3, 130, 130), 90, np.uint8), placed(size=130, frame=frame)
    left = base * Affine.translation(-70, 0)
    right = base * Affine.translation(60, shift_px)
    paths = [
        write(tmp_path / "left.tif", bands, transform=left),
        write(tmp_path / "right.tif", bands * 2, transform=right),
    ]
    pixels = read(paths, 90, 1.0, frame)
    assert pixels.valid[2:-2, 2:-2].all()
    values = pixels.rgb[2:-2, 2:-2]
    assert set(np.unique(values[:, :20])) == {90} and set(np.unique(values[:, -20:])) == {180}
    assert values.min() >= 80 and values.max() <= 190
