"""Every kind of orthophoto comes out as the same picture, with what is missing marked."""

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from geotiffs import SIZE, placed, read, smooth_scene, write
from rasterio.drivers import raster_driver_extensions
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from scipy.ndimage import binary_dilation

from orthonav.core.errors import ImageryError
from orthonav.ground.imagery.mosaic import Mosaic

INNER = np.s_[4:-4, 4:-4]
RGB = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
NIR, ALPHA, PALETTE = ColorInterp.undefined, ColorInterp.alpha, ColorInterp.palette
SCENE = smooth_scene()
HOLE = np.zeros((SIZE, SIZE), dtype=bool)
HOLE[20:50, 30:70] = True
MASK = np.where(HOLE, 0, 255).astype(np.uint8)


def with_band(bands, extra):
    return np.concatenate([bands, extra[None].astype(bands.dtype)])


def rgb_nir_as_gdal_marks_it(path):
    """GDAL marks the fourth of four bands as alpha by default."""
    return write(path, with_band(SCENE, 255 - SCENE[0]))


def south_up(path):
    flip = Affine.translation(0, SIZE) * Affine.scale(1, -1)
    return write(path, SCENE[:, ::-1], transform=placed() * flip)


def vrt(path):
    rasterio.shutil.copy(write(path, SCENE), path.with_suffix(".vrt"), driver="VRT")
    return path.with_suffix(".vrt")


def jpeg2000(path):
    if "jp2" not in raster_driver_extensions():
        pytest.skip("this GDAL has no JPEG 2000 driver (JP2OpenJPEG)")
    path = path.with_suffix(".jp2")
    return write(path, SCENE, driver="JP2OpenJPEG", quality=100, reversible="YES")


JPEG = {"compress": "JPEG", "photometric": "YCBCR", "tiled": True, "jpeg_quality": 98}
WHOLE = {
    "rgb": lambda path: write(path, SCENE),
    "jpeg": lambda path: write(path, SCENE, **JPEG),
    "near infrared": lambda path: write(
        path, with_band(SCENE, 255 - SCENE[0]), colours=[*RGB, NIR], alpha="NO"
    ),
    "alpha of GDAL": rgb_nir_as_gdal_marks_it,
    "bgr": lambda path: write(path, SCENE[::-1], colours=RGB[::-1]),
    "full mask": lambda path: write(path, SCENE, mask=np.full_like(MASK, 255)),
    "south up": south_up,
    "vrt": vrt,
    "jpeg 2000": jpeg2000,
}


@pytest.mark.parametrize("kind", WHOLE)
def test_colour_of_every_kind_is_the_same_picture(tmp_path, kind):
    pixels = read(WHOLE[kind](tmp_path / "ortho.tif"))
    assert pixels.rgb.shape == (SIZE, SIZE, 3) and pixels.rgb.dtype == np.uint8
    assert pixels.valid[INNER].all()
    off = np.abs(pixels.rgb[INNER].astype(int) - SCENE.transpose(1, 2, 0)[INNER])
    assert off.max() <= (8 if kind == "jpeg" else 3)


@pytest.mark.parametrize(
    "dtype, scale, offset",
    [("uint16", 16, 100), ("int16", 20, -3000), ("float32", 1 / 255, 0), ("float64", 1e4, -7e5)],
)
@pytest.mark.parametrize("bands", [3, 4])
def test_deeper_pixels_are_stretched_alike(tmp_path, dtype, scale, offset, bands):
    scene = with_band(SCENE, SCENE[0])[:bands]
    deep = (scene * float(scale) + offset).astype(dtype)
    path = write(tmp_path / "ortho.tif", deep, colours=[*RGB, NIR] if bands == 4 else None)
    mosaic = Mosaic.open([path])
    expected = mosaic.stretches[0].apply(deep)[:3].transpose(1, 2, 0)
    assert expected.min() == 0 and expected.max() == 255
    pixels = read(path)
    assert pixels.valid[INNER].all()
    assert np.abs(pixels.rgb[INNER].astype(int) - expected[INNER]).max() <= 5


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32", "float64"])
def test_one_band_that_may_hold_heights_is_refused(tmp_path, dtype):
    path = write(tmp_path / "surface.tif", SCENE[:1].astype(dtype))
    with pytest.raises(ImageryError, match=rf"one band of {dtype} may hold heights.*surface\.tif"):
        Mosaic.open([path])


@pytest.mark.parametrize("gsd_m", [1, 2])
@pytest.mark.parametrize("alpha", [False, True])
def test_a_palette_is_read_as_its_colours(tmp_path, gsd_m, alpha):
    """Numbers of neighbouring colours are far apart: means of numbers would be other colours."""
    band = cv2.GaussianBlur(SCENE[0], (0, 0), 4) // 16 * 16
    numbers = (37 * band.astype(int) % 256).astype(np.uint8)
    bands = np.stack([numbers, np.full_like(band, 255)][: 1 + alpha])
    path = write(tmp_path / "ortho.tif", bands, colours=[PALETTE, ALPHA][: 1 + alpha])
    table = dict.fromkeys(range(256), (255, 0, 255, 255))  # of numbers that do not occur
    table |= {37 * value % 256: (value, 255 - value, 7, 255) for value in range(0, 256, 16)}
    with rasterio.open(path, "r+") as data:
        data.write_colormap(1, table)
    pixels = read(path, gsd_m=gsd_m)
    red, green, blue = pixels.rgb[pixels.valid].astype(int).T
    assert pixels.valid.mean() > 0.2 and len(np.unique(red)) > 4
    assert np.mean(np.abs(red + green - 255) <= 2) > 0.98 and np.mean(np.abs(blue - 7) <= 2) > 0.98
    if gsd_m == 1:
        assert np.mean(np.abs(red - band[pixels.valid].astype(int)) <= 2) > 0.9
    with pytest.raises(ImageryError, match="leave --bands out"):
        Mosaic.open([path], bands=(1,))


def test_bands_as_asked(tmp_path):
    path = write(tmp_path / "ortho.tif", with_band(SCENE, SCENE[1]), colours=[*RGB, NIR])
    grey = Mosaic.open([path], bands=(2,))
    assert grey.sources[0].bands == (2,) and len(Mosaic.open([path]).sources[0].bands) == 3
    with pytest.raises(ImageryError, match=r"has bands 1 to 4, not 5: .*ortho\.tif"):
        Mosaic.open([path], bands=(5,))
    with pytest.raises(ImageryError, match="one or three, not 1, 2"):
        Mosaic.open([path], bands=(1, 2))
    deep = write(tmp_path / "deep.tif", with_band(SCENE, SCENE[1]).astype(np.float32))
    assert Mosaic.open([deep], bands=(4,)).sources[0].bands == (4,)
    (tmp_path / "folder").mkdir()
    write(tmp_path / "folder" / "four.tif", with_band(SCENE, SCENE[1]), colours=[*RGB, NIR])
    write(tmp_path / "folder" / "dem.tif", SCENE[:1].astype(np.float32))
    assert len(Mosaic.open([tmp_path / "folder"], bands=(4,)).sources) == 1


@pytest.mark.parametrize("dtype, top", [("uint8", 255), ("uint16", 65_535)])
def test_a_band_marked_alpha_that_is_a_picture_masks_nothing(tmp_path, caplog, dtype, top):
    scene = np.tile(SCENE, (1, 9, 9)).astype(dtype) * (top // 255)
    infrared = np.where(np.arange(9 * SIZE) < 60, 0, top - scene[0])
    path = write(tmp_path / "ortho.tif", with_band(scene, infrared), colours=[*RGB, ALPHA])
    with caplog.at_level("INFO"):
        mosaic = Mosaic.open([path])
    assert f"ignored: {path}" in caplog.text and mosaic.sources[0].bands == (1, 2, 3)
    for gsd_m in (1, 4):
        pixels = read(path, 240, gsd_m=gsd_m)
        assert pixels.valid[INNER].all() and pixels.rgb[..., 0][INNER].std() > 30


DEEP, UNIT = SCENE.astype(np.uint16) * 100, (SCENE / 255).astype(np.float32)
WATER = np.where(np.arange(SIZE) < 40, 0, 255 - SCENE[0])
"""Near infrared, which is 0 over water; it is not missing for that."""
HOLED = {
    "nodata": lambda path: write(path, np.where(HOLE, 0, SCENE), nodata=0),
    "white": lambda path: write(path, np.where(HOLE, 255, SCENE), nodata=255),
    "beside false alpha": lambda path: write(
        path, np.where(HOLE, 0, with_band(SCENE, WATER)).astype(np.uint8), nodata=0
    ),
    "grey nodata": lambda path: write(path, np.where(HOLE, 0, SCENE[:1]), nodata=0),
    "grey alpha": lambda path: write(path, with_band(SCENE[:1], MASK), alpha="YES"),
    "alpha": lambda path: write(path, with_band(SCENE, MASK), colours=[*RGB, ALPHA]),
    "deep alpha": lambda path: write(
        path, with_band(DEEP, MASK.astype(np.uint16) * 257), colours=[*RGB, ALPHA]
    ),
    "mask": lambda path: write(path, np.where(HOLE, 90, SCENE).astype(np.uint8), mask=MASK),
    "jpeg mask": lambda path: write(path, np.where(HOLE, 0, SCENE), mask=MASK, **JPEG),
    "float": lambda path: write(path, np.where(HOLE, -9999, UNIT), nodata=-9999),
    "nan": lambda path: write(path, np.where(HOLE, np.nan, UNIT), nodata=np.nan),
    "nan undeclared": lambda path: write(path, np.where(HOLE, np.nan, UNIT)),
    "deep": lambda path: write(path, np.where(HOLE, 0, DEEP), nodata=0),
}


@pytest.mark.parametrize("kind", HOLED)
def test_holes_of_every_kind_are_marked_and_not_mixed_with_the_ground(tmp_path, kind):
    path = HOLED[kind](tmp_path / "ortho.tif")
    pixels, stretch = read(path), Mosaic.open([path]).stretches[0]
    inner = np.zeros_like(HOLE)
    inner[INNER] = True
    assert not pixels.valid[HOLE].any() and not pixels.rgb[~pixels.valid].any()
    assert pixels.valid[inner & ~binary_dilation(HOLE, iterations=2)].all()
    is_lossy = kind == "jpeg mask"
    if stretch is None:
        expected = SCENE[:1] if kind.startswith("grey") else SCENE
        clear = inner & ~binary_dilation(HOLE, iterations=16 if is_lossy else 3)
        off = np.abs(pixels.rgb.transpose(2, 0, 1).astype(int) - expected)[:, clear]
        assert off.max() <= (8 if is_lossy else 3)
    whole = np.where(HOLE, 128, SCENE).astype(float)
    if stretch is not None:
        whole = np.interp(whole, [np.percentile(SCENE, 0.5), np.percentile(SCENE, 99.5)], [0, 255])
    rim = pixels.valid & binary_dilation(HOLE, iterations=3)
    assert rim.sum() > 100 and np.abs(pixels.rgb[..., 0] - whole[0])[rim].max() <= 30


def shifted(path, cols, level, **more):
    bands = np.full((3, SIZE, SIZE), level, np.uint8)
    return write(path, bands, transform=placed() * Affine.translation(cols, 0), **more)


def test_first_named_wins_and_gaps_stay_gaps(tmp_path):
    """Columns 0..120 of the first, 80..200 of the second, a gap, 220..340 of the third."""
    paths = [
        shifted(tmp_path / f"{level}.tif", cols, level)
        for cols, level in ((-100, 50), (-20, 100), (120, 200))
    ]
    row, width = SIZE, 3 * SIZE
    for order, overlap in ((paths, 50), (paths[::-1], 100)):
        pixels = read(order, width)
        line, valid = pixels.rgb[row + 60, :, 1], pixels.valid[row + 60]
        left = SIZE - 100
        assert (line[left + 3 : left + 77] == 50).all()
        assert (line[left + 83 : left + 117] == overlap).all()
        assert (line[left + 123 : left + 197] == 100).all()
        assert not valid[left + 203 : left + 217].any()
        assert (line[left + 223 : left + 337] == 200).all()
        assert valid[left + 3 : left + 197].all()


@pytest.mark.parametrize(
    "name, tags, expected",
    [
        ("ortho", {"TIFFTAG_DATETIME": "2021:06:17 10:00:00"}, "2021-06-17"),
        ("ortho_2019", {"ACQUISITION_DATE": "2021-06"}, "2021-06"),
        ("BDORTHO_2154_2018-07_0M20", {}, "2018-07"),
    ],
)
def test_what_the_manifest_keeps(tmp_path, name, tags, expected):
    path = write(tmp_path / f"{name}.tif", SCENE)
    with rasterio.open(path, "r+") as data:
        data.update_tags(**tags)
    mosaic = Mosaic.open([path])
    kept = mosaic.sources[0].describe()
    assert kept["date"] == expected and kept["name"] == f"{name}.tif"
    assert (kept["width_px"], kept["height_px"], kept["dtype"]) == (SIZE, SIZE, "uint8")
    assert mosaic.gsd_m == pytest.approx(1.0, rel=1e-3) and kept["crs"] == "EPSG:2154"
