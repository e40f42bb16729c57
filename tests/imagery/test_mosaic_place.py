"""A thing on the ground comes out where PROJ says it is, whatever the file and the window."""

import cv2
import numpy as np
import pytest
from geotiffs import FRAME, LAMBERT, centres_en_m, from_local, placed, read, sheet_of, write

from orthonav.core.geo.frames import LocalFrame

BREST = LocalFrame(48.39, -4.49)  # Lambert-93 is turned by -5.4 degrees here
VOSGES = LocalFrame(46.5, 7.5)
MARKS_EN_M = np.array([[e, n] for e in (-70, 0, 55) for n in (-60, 10, 70)], dtype=float)


def source_with_marks(path, crs, transform, size, frame, sigma_px):
    """Round marks at `MARKS_EN_M`, placed by PROJ; (x, y) of a pixel is its centre."""
    x, y = from_local(crs, frame).transform(*MARKS_EN_M.T)
    cols, rows = ~transform * (np.asarray(x), np.asarray(y))
    along = np.arange(size) + 0.5
    grey = np.full((size, size), 40.0)
    for col, row in zip(cols, rows, strict=True):
        grey += 180 * np.exp(-((along - col) ** 2 + (along[:, None] - row) ** 2) / 2 / sigma_px**2)
    return write(path, np.rint(grey).astype(np.uint8)[None], crs=crs, transform=transform)


def marks_off_px(grey, gsd_m):
    """How far the centroid of each mark lies from where it should, in pixels of the sheet."""
    east, north = centres_en_m(len(grey), gsd_m)
    off = []
    for mark_east, mark_north in MARKS_EN_M:
        near = np.maximum(abs(east - mark_east), abs(north - mark_north)) < 10 * max(1.0, gsd_m)
        weight = np.where(near, np.maximum(grey.astype(float) - 45, 0), 0)
        centroid = np.array([(east * weight).sum(), (north * weight).sum()]) / weight.sum()
        off.append((centroid - (mark_east, mark_north)) / gsd_m)
    return np.array(off)


@pytest.mark.parametrize(
    "crs, frame, source_gsd_m, turn_deg, gsd_m",
    [
        (LAMBERT, BREST, 1.0, 0, 1.0),
        (LAMBERT, BREST, 0.2, 0, 1.0),
        (LAMBERT, FRAME, 1.0, 30, 1.0),
        (LAMBERT, BREST, 0.5, -100, 1.0),
        ("EPSG:3857", FRAME, 1.0, 0, 1.0),
        ("EPSG:3857", VOSGES, 0.25, 0, 1.0),
        ("EPSG:4326", BREST, 0.3, 0, 1.0),
        ("EPSG:32632", VOSGES, 0.6, 0, 0.5),
        ("EPSG:4258", FRAME, 0.8, 0, 2.0),
        ("ESRI:102014", FRAME, 1.0, 0, 1.0),
        ("EPSG:32760", LocalFrame(-17.0, 180.0), 0.5, 0, 1.0),
    ],
)
def test_marks_lie_where_proj_puts_them(tmp_path, crs, frame, source_gsd_m, turn_deg, gsd_m):
    size = int(290 / source_gsd_m)
    transform = placed(crs, source_gsd_m, size, turn_deg, frame)
    path = tmp_path / "ortho.tif"
    source_with_marks(path, crs, transform, size, frame, sigma_px=2.5 / source_gsd_m)
    pixels = read(path, int(200 / gsd_m), gsd_m, frame)
    off = marks_off_px(pixels.grey, gsd_m)
    assert pixels.valid.all()
    assert np.abs(off).max() < 0.1, f"marks are off by up to {np.abs(off).max():.2f} px"
    assert np.abs(off.mean(axis=0)).max() < 0.03


def rich_scene(size, source_gsd_m, seed=0):
    """Structure at all scales from two sheet pixels up."""
    noise = np.random.default_rng(seed).normal(size=(3, size, size)).astype(np.float32)
    bands = np.zeros_like(noise)
    for band, out in zip(noise, bands, strict=True):
        for sigma_m in (1, 4):
            layer = cv2.GaussianBlur(band, (0, 0), sigma_m / source_gsd_m)
            out += layer / layer.std()
    return np.clip(128 + 35 * bands, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "crs, frame, source_gsd_m",
    [
        (LAMBERT, FRAME, 1.0),
        (LAMBERT, BREST, 1.0),
        (LAMBERT, FRAME, 0.4),
        ("EPSG:3857", VOSGES, 0.3),
        ("EPSG:4326", FRAME, 1.0),
    ],
)
def test_windows_do_not_change_what_is_read(tmp_path, crs, frame, source_gsd_m):
    size = int(260 / source_gsd_m)
    transform = placed(crs, source_gsd_m, size, frame=frame)
    scene = rich_scene(size, source_gsd_m)
    path = write(tmp_path / "ortho.tif", scene, crs=crs, transform=transform)
    with sheet_of(path, 200, 1.0, frame) as sheet:
        whole = sheet.read(0, 0, 200, 200)
        for col, row, width, height in [
            (0, 0, 100, 100),
            (100, 0, 100, 100),
            (0, 100, 100, 100),
            (100, 100, 100, 100),
            (37, 61, 1, 1),
            (13, 90, 171, 7),
            (150, 0, 9, 200),
        ]:
            part = sheet.read(col, row, width, height)
            window = np.s_[row : row + height, col : col + width]
            off = np.abs(part.rgb.astype(int) - whole.rgb[window])
            assert (part.valid == whole.valid[window]).all()
            assert off.max() <= 2, f"{off.max()} grey levels at {col}, {row}"


@pytest.mark.parametrize("gsd_m", [0.5, 1.0, 2.0])
def test_a_window_that_starts_in_the_middle_of_the_sheet(tmp_path, gsd_m):
    """GDAL takes a raster at (0, 0) with pixels of 1 for one without georeference."""
    path = write(tmp_path / "ortho.tif", rich_scene(260, 1.0))
    with sheet_of(path, 100, gsd_m) as sheet:
        whole, quarter = sheet.read(0, 0, 100, 100), sheet.read(50, 50, 50, 50)
    assert quarter.valid.all()
    assert np.abs(quarter.rgb.astype(int) - whole.rgb[50:, 50:]).max() <= 2


@pytest.mark.parametrize("coarser", [2, 3, 4, 5, 8, 2.5, 3.4])
@pytest.mark.parametrize("deep", [False, True], ids=["8 bit", "16 bit"])
def test_a_fine_chequerboard_comes_out_grey(tmp_path, coarser, deep):
    board = np.indices((3, 600, 600))[1:].sum(axis=0) % 2 * 255
    bands = board.astype(np.uint16 if deep else np.uint8)
    path = write(tmp_path / "board.tif", bands, transform=placed(gsd_m=0.2, size=600))
    pixels = read(path, int(100 / coarser / 0.2 / 5) * 4, gsd_m=0.2 * coarser)
    inner = pixels.grey[3:-3, 3:-3].astype(float)
    assert pixels.valid[3:-3, 3:-3].all()
    assert inner.mean() == pytest.approx(127.5, abs=3)
    assert np.abs(inner - 127.5).max() <= 127.5 / coarser**2 * 2.5 + 3
