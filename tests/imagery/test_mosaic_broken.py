"""Orthophotos that cannot be used are refused in words; big ones are read in bounded memory."""

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from geotiffs import FRAME, LAMBERT, SIZE, read, sheet_of, smooth_scene, write
from rasterio.control import GroundControlPoint
from rasterio.drivers import raster_driver_extensions
from rasterio.transform import Affine

from orthonav.core.errors import AreaError, ImageryError, MissingFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.mosaic import Mosaic

SCENE = smooth_scene()


@pytest.fixture
def ortho(tmp_path):
    """Where the orthophoto of a test is written."""
    return tmp_path / "ortho.tif"


def refused(path, message, error=ImageryError):
    with pytest.raises(error, match=message) as caught:
        Mosaic.open([path])
    assert str(caught.value).endswith(str(path))


def test_files_that_are_no_image(ortho):
    refused(ortho, "does not exist", MissingFileError)
    ortho.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    refused(ortho, "Git LFS pointer.*git lfs pull", MissingFileError)
    for content in (b"", b"not an image", b"II*\0" + b"\xff" * 40, bytes(4096)):
        ortho.write_bytes(content)
        refused(ortho, "cannot be read")


@pytest.mark.parametrize("assigned", [False, True])
def test_ground_control_points_only(ortho, assigned):
    corners = [(0, 0), (0, SIZE), (SIZE, 0), (SIZE, SIZE)]
    points = [GroundControlPoint(row, col, 7e5 + col, 66e5 - row) for row, col in corners]
    write(ortho, SCENE, transform=Affine.identity(), gcps=points)
    if assigned:
        with rasterio.open(ortho, "r+") as data:
            data.crs = LAMBERT
    refused(ortho, "4 ground control points only.*gdalwarp -tps")


@pytest.mark.parametrize(
    "profile, message",
    [
        ({"crs": None}, "no coordinate reference system.*gdal_edit.py"),
        ({"transform": Affine.identity()}, "no georeference"),
        ({"crs": 'LOCAL_CS["mine",UNIT["metre",1]]'}, "border cannot be converted to latitude"),
        ({"crs": "EPSG:4326"}, "border cannot be converted to latitude"),
        (
            {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 179.9999, 0, -1e-5, -17)},
            "beyond longitude 180",
        ),
    ],
)
def test_places_that_cannot_be_used(ortho, profile, message):
    refused(write(ortho, SCENE, **profile), message)


@pytest.mark.parametrize("dtype, nodata", [("uint16", 0), ("float32", -1), ("float32", np.nan)])
def test_deep_images_of_nothing_but_nodata(ortho, dtype, nodata):
    write(ortho, np.full((3, SIZE, SIZE), nodata, dtype), nodata=nodata)
    with pytest.raises(ImageryError, match="no valid pixel"):
        Mosaic.open([ortho])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_no_map_is_built_from_nothing_but_nodata(ortho, tmp_path, dtype):
    write(ortho, np.zeros((3, SIZE, SIZE), dtype), nodata=0)
    with pytest.raises((AreaError, ImageryError), match="nodata"):
        build_map(BuildRequest([ortho], tmp_path / "area.onav", tile_px=32, overlap=0.5))
    assert list(tmp_path.iterdir()) == [ortho]


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_one_level_everywhere_is_no_division_by_zero(ortho, dtype):
    write(ortho, np.full((3, SIZE, SIZE), 700, dtype))
    pixels = read(ortho)
    assert pixels.valid[4:-4, 4:-4].all() and not pixels.rgb.any()


@pytest.mark.parametrize("missing, said", [(-9999, True), (-3.4e38, True), (np.nan, False)])
def test_an_unstated_value_of_missing_pixels_is_said(ortho, caplog, missing, said):
    bands = (noise(SIZE) / 255).astype(np.float32)
    bands[:, :20] = missing
    write(ortho, bands)
    Mosaic.open([ortho])
    assert ("one grey level" in caplog.text) == said


def noise(size=512):
    return np.random.default_rng(0).integers(0, 256, (3, size, size)).astype(np.uint8)


TILED = {"tiled": True, "blockxsize": 256, "blockysize": 256}
KINDS = {
    "deflate tiles": {"compress": "DEFLATE"} | TILED,
    "deflate strips": {"compress": "DEFLATE"},
    "lzw tiles": {"compress": "LZW"} | TILED,
    "jpeg tiles": {"compress": "JPEG", "photometric": "YCBCR"} | TILED,
    "plain": {},
    "JPEG": {"driver": "JPEG"},
    "PNG": {"driver": "PNG"},
    "JP2OpenJPEG": {"driver": "JP2OpenJPEG"},
}


def made(kind, ortho):
    """A file of noise of that kind."""
    driver = KINDS[kind].get("driver", "GTiff")
    if driver not in raster_driver_extensions().values():
        pytest.skip(f"this GDAL has no {driver} driver")
    if driver == "GTiff":
        return write(ortho, noise(), **KINDS[kind])
    path = ortho.with_suffix({"JPEG": ".jpg", "PNG": ".png", "JP2OpenJPEG": ".jp2"}[driver])
    rasterio.shutil.copy(write(ortho, noise()), path, driver=driver)
    return path


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("kind", KINDS)
def test_an_incomplete_file_is_an_error(ortho, kind, kept):
    path = made(kind, ortho)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ImageryError, match="cannot be read") as caught:
        read(path, 500)
    assert "previous exception" not in str(caught.value)


def test_a_coordinate_system_whose_name_is_no_text(ortho):
    write(ortho, noise(), crs=FRAME.proj4)
    ortho.write_bytes(ortho.read_bytes().replace(b"unknown|", b"unkno\xb1n|"))
    with pytest.raises(ImageryError, match="cannot be read"):
        Mosaic.open([ortho])


@pytest.mark.parametrize("kind", ["deflate tiles", "lzw tiles", "jpeg tiles", "PNG"])
def test_altered_bytes_are_noticed(ortho, kind):
    path = made(kind, ortho)
    content = bytearray(path.read_bytes())
    middle = slice(len(content) // 2, len(content) // 2 + 2000)
    content[middle] = bytes(byte ^ 0x5A for byte in content[middle])
    path.write_bytes(bytes(content))
    with pytest.raises(ImageryError, match="cannot be read"):
        read(path, 500)


def test_a_deep_file_that_was_cut_short(ortho):
    write(ortho, noise().astype(np.uint16), compress="DEFLATE", **TILED)
    ortho.write_bytes(ortho.read_bytes()[: ortho.stat().st_size // 2])
    with pytest.raises(ImageryError, match=r"cannot be read.*ortho\.tif"):
        Mosaic.open([ortho])


def test_a_place_outside_the_area_of_its_system(ortho):
    """Northings of France in the system of Mayotte."""
    write(ortho, SCENE, crs="EPSG:4471", transform=Affine(1, 0, 7e5, 0, -1, 66e5 + 60))
    with pytest.raises(ImageryError, match="does not fit its coordinate system"):
        read(ortho, frame=LocalFrame(-30.715, 47.089))


def test_a_file_that_vanishes_is_named(ortho):
    sheet = sheet_of(write(ortho, SCENE))
    ortho.unlink()
    with sheet, pytest.raises(ImageryError, match=r"cannot be read.*ortho\.tif"):
        sheet.read(0, 0, 50, 50)
