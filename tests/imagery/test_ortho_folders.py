"""A folder as its producer delivers it is an orthophoto; other files in it are skipped."""

import sqlite3
from contextlib import closing

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.shutil
from geotiffs import placed, read, smooth_scene, write
from rasterio.drivers import raster_driver_extensions
from rasterio.transform import Affine

from orthonav.core.errors import ImageryError
from orthonav.core.mapfile import open_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.source import date_of, system_of

SCENE = smooth_scene(200)
PACKAGE = "BDORTHO_2-0_RVB-1M00_JP2-E080_LAMB93_D003_2013-01-01"
TILES = f"{PACKAGE}/ORTHOHR/1_DONNEES_LIVRAISON_2013-11-00100/BDO_RVB_1M00_JP2-E080_LAMB93_D03-2013"


def tiles(folder, suffix=".tif", name="tile_{0}_{1}", scene=SCENE, **more):
    """The scene in four files."""
    size, side = 200, 100
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for row in range(0, size, side):
        for col in range(0, size, side):
            part = np.ascontiguousarray(scene[:, row : row + side, col : col + side])
            here = placed(size=size) * Affine.translation(col, row)
            path = folder / (name.format(row // side, col // side) + suffix)
            paths.append(write(path, part, transform=here, **more))
    return paths


@pytest.fixture
def whole(tmp_path):
    """The picture of the scene when it is one file."""
    return read(write(tmp_path / "a.tif", SCENE, transform=placed(size=200)), 190)


def ign(folder, **more):
    """A package of BD ORTHO: JPEG 2000, no system in the files, sidecars and other things."""
    if "jp2" not in raster_driver_extensions():
        pytest.skip("this GDAL has no JPEG 2000 driver (JP2OpenJPEG)")
    name = "03-2013-{1:04}-66{0:02}-LA93-1M00-E080"
    options = {"driver": "JP2OpenJPEG", "quality": 100, "reversible": "YES", "crs": None} | more
    paths = tiles(folder / TILES, ".jp2", name, **options)
    above = folder / PACKAGE / "ORTHOHR" / "3_SUPPLEMENTS_LIVRAISON_2013-11-00100"
    above.mkdir()
    for extra in ("dalles.shp", "dalles.dbf", "lisez-moi.pdf"):
        (above / extra).write_bytes(b"other")
    write(above / "assemblage_03.tif", SCENE, crs=None, transform=Affine.identity())
    return paths


def test_a_package_of_bd_ortho(tmp_path, whole, caplog):
    ign(tmp_path / "ign")
    with caplog.at_level("INFO"):
        mosaic = Mosaic.open([tmp_path / "ign"])
    assert len(mosaic.sources) == 4 and {source.date for source in mosaic.sources} == {"2013"}
    assert {source.crs for source in mosaic.sources} == {"EPSG:2154"}
    assert "EPSG:2154" in caplog.text and "4 orthophotos" in caplog.text
    (entry,) = mosaic.describe()
    assert entry["name"] == "ign" and entry["files"] == 4 and entry["date"] == "2013"
    pixels = read(tmp_path / "ign", 190)
    np.testing.assert_array_equal(pixels.valid, whole.valid)
    assert np.abs(pixels.rgb.astype(int) - whole.rgb).max() <= 2


@pytest.mark.parametrize(
    "names, date, system",
    [
        (["03-2013-0712-6600-LA93-0M50-E080"], "2013", "EPSG:2154"),
        (["2A-2019-1165-6110-LA93-0M20-E080"], "2019", "EPSG:2154"),
        (["tile", "OHR_RVB_0M20_JP2-E080_LAMB93_D03-2022"], "2022", "EPSG:2154"),
        (["tile", PACKAGE], "2013", "EPSG:2154"),
        (["974-2017-0340-7650-x"], "2017", None),
        (["BDORTHO_2-0_RVB-0M20_JP2-E080_RGR92UTM40S_D974_2017-01-01"], "2017", "EPSG:2975"),
        (["LAMB93X", "XLA93", "BLA93", "lamb93"], None, None),
        (["swissimage-dop10_2022_2600-1200_0.1_2056"], "2022", None),
        (["m_4710060_ne_14_060_20200715"], "2020-07-15", None),
        (["tile_7", "ortho_2019"], "2019", None),
        (["ortho_2019_00"], "2019", None),
        (["dop_2048x2048", "tile_2000x2000", "1024X1999_b", "tile_2000px"], None, None),
        (["tile_2040_1899", "1234567"], None, None),
        (["tile_2000_px_2018"], "2018", None),
        (["bordeaux2018"], "2018", None),
        (["2000x2000_2019-05"], "2019-05", None),
    ],
)
def test_what_names_tell(names, date, system):
    assert date_of({}, names) == date and system_of(names) == system


def test_a_folder_of_several_years(tmp_path):
    """The newest covers the others; from when to when is in the manifest."""
    for year, level in ((2015, 50), (2021, 150), (2018, 100)):
        flat = np.full((3, 200, 200), level, np.uint8)
        tiles(tmp_path / "f", name=f"{year}_{{0}}_{{1}}", scene=flat)
    mosaic = Mosaic.open([tmp_path / "f"])
    assert (read(tmp_path / "f", 150).rgb[5:-5, 5:-5] == 150).all()
    (entry,) = mosaic.describe()
    assert (entry["date_from"], entry["date"], entry["files"]) == ("2015", "2021", 12)
    assert "width_px" not in entry


def test_skipped_files_are_logged_with_reasons(tmp_path, caplog):
    folder = tmp_path / "f"
    tiles(folder / "deep" / "er")
    for name in ("a.tif.ovr", "a.tif.aux.xml", "a.tif.msk", "a.tfw", "notes.txt", ".hidden.tif"):
        (folder / name).write_bytes(b"?")
    (folder / "old.ecw").write_bytes(b"?")
    (folder / "rest.7z.001").write_bytes(b"?")
    write(folder / "tile_thumb.tif", SCENE, transform=placed(size=200))
    write(folder / "heights.tif", SCENE[:1].astype(np.float32), transform=placed(size=200))
    write(folder / "figure.tif", SCENE, crs=None, transform=Affine.identity())
    with caplog.at_level("INFO"):
        mosaic = Mosaic.open([folder])
    assert [source.path.name for source in mosaic.sources] == [
        f"tile_{row}_{col}.tif" for row in (0, 1) for col in (0, 1)
    ]
    for reason in ("1 .001", "1 .ecw", "1 thumbnails", "figure.tif", "may hold heights"):
        assert reason in caplog.text


GREY = smooth_scene(200)[:1]


def layer(path, bands=GREY, **more):
    path.parent.mkdir(exist_ok=True, parents=True)
    return write(path, bands, transform=placed(size=200), **more)


@pytest.mark.parametrize(
    "bands",
    [
        ["T31UDQ_20160712T105621_B02_10m", "T31UDQ_20160712T105621_B03_10m"],
        ["LC08_L2SP_199026_20200101_02_T1_SR_B2", "LC08_L2SP_199026_20200101_02_T1_SR_B4"],
        ["intensity", "north"],
    ],
)
def test_bands_of_one_scene_are_not_several_orthophotos(tmp_path, bands):
    for name in bands:
        layer(tmp_path / "f" / f"{name}.tif", GREY.astype(np.uint16) * 20)
    with pytest.raises(
        ImageryError, match=rf"{bands[0]}\.tif, {bands[1]}\.tif are grey and of one"
    ):
        Mosaic.open([tmp_path / "f"])


def test_bands_given_one_by_one_are_named(tmp_path, caplog):
    paths = [layer(tmp_path / f"B0{n}.tif", GREY.astype(np.uint16) * 20) for n in (2, 3)]
    Mosaic.open(paths)
    assert "imagery: using B02.tif, not B03.tif: of one place and date: they fill" in caplog.text
    caplog.clear()
    Mosaic.open(paths, bands=(1,))
    assert not caplog.text


def test_colours_of_a_scene_stand_for_its_bands(tmp_path, caplog):
    layer(tmp_path / "f" / "B02.tif")
    layer(tmp_path / "f" / "TCI.tif", SCENE)
    (source,) = Mosaic.open([tmp_path / "f"]).sources
    assert source.path.name == "TCI.tif"
    assert "imagery: using TCI.tif, not B02.tif: of one place and date (1 such" in caplog.text


def test_packages_share_the_tiles_of_their_border(tmp_path, caplog):
    for name in ("a", "b"):
        layer(tmp_path / "f" / name / "03-2022-0710-6600.tif")
    assert len(Mosaic.open([tmp_path / "f"]).sources) == 1 and not caplog.text


@pytest.mark.parametrize(
    "name, bands",
    [
        ("T31UDQ_20160712T105621_AOT_10m", GREY),
        ("LC08_L1TP_199026_20200101_02_T1_QA_PIXEL", GREY.astype(np.uint16)),
        ("2021_hillshade_1m", GREY),
        ("valid", (GREY > 100) * np.uint8(255)),
        ("classes", GREY // 32),
        ("vapour", np.full_like(GREY, 143, np.uint16)),
    ],
)
def test_layers_that_show_no_ground(tmp_path, name, bands, caplog):
    path = layer(tmp_path / "f" / f"{name}.tif", bands)
    with pytest.raises(ImageryError, match="is a mask or another layer, not a picture"):
        Mosaic.open([path])
    layer(tmp_path / "f" / "ortho_2016.tif", SCENE)
    (source,) = Mosaic.open([tmp_path / "f"]).sources
    assert source.path.name == "ortho_2016.tif" and f"{name}.tif" in caplog.text


def test_photographs_are_not_orthophotos(tmp_path):
    """With the metadata of a camera, and no georeference."""
    exif = bytes.fromhex("45786966000049492a000800000001000f010200040000004e696b000000000000")
    cv2.imwrite(str(tmp_path / "bare.jpg"), GREY[0])
    bare = (tmp_path / "bare.jpg").read_bytes()
    head = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "DCIM").mkdir()
    photo = tmp_path / "DCIM" / "DJI_0001.JPG"
    photo.write_bytes(bare[:2] + head + bare[2:])
    for path in (photo, tmp_path / "DCIM"):
        with pytest.raises(ImageryError, match=r"photograph: build .* from an ortho.*0001\.JPG"):
            Mosaic.open([path])


@pytest.mark.parametrize(
    "names, seen",
    [
        ([], "nothing"),
        (["a.txt", "b.txt", "c.shp"], r"2 \.txt, 1 \.shp"),
        (["x.zip", "tile_thumb.tif"], r"1 thumbnails.*, 1 \.zip"),
    ],
)
def test_a_folder_without_orthophotos(tmp_path, names, seen):
    for name in names:
        (tmp_path / name).write_bytes(b"?")
    with pytest.raises(ImageryError, match=f"unpack archives first.*it holds {seen}: "):
        Mosaic.open([tmp_path])


def test_broken_files_in_a_folder_are_errors(tmp_path):
    paths = tiles(tmp_path / "f")
    paths[2].write_bytes(paths[2].read_bytes()[:200])
    with pytest.raises(ImageryError, match="cannot be read"):
        read(tmp_path / "f", 190)
    paths[2].write_bytes(b"nothing")
    with pytest.raises(ImageryError, match=r"cannot be read.*tile_1_0\.tif"):
        Mosaic.open([tmp_path / "f"])
    write(paths[2], SCENE, crs=None, transform=placed(size=200))
    with pytest.raises(ImageryError, match=r"no coordinate reference.*tile_1_0\.tif"):
        Mosaic.open([tmp_path / "f"])


@pytest.mark.parametrize("system", ["LA93", "prj"])
def test_world_files(tmp_path, whole, system):
    """PNG, JPEG and TIFF with world files, in Lambert-93 by their names or a .prj of ESRI."""
    flat = write(tmp_path / "flat.tif", SCENE, crs=None, transform=Affine.identity())
    corner = placed(size=200)
    world = [corner.a, 0, 0, corner.e, corner.c + corner.a / 2, corner.f + corner.e / 2]
    for name, driver, sidecar in (
        (f"a_{system}.png", "PNG", ".pgw"),
        (f"a_{system}.jpg", "JPEG", ".jgw"),
        (f"a_{system}.tif", "GTiff", ".tfw"),
    ):
        folder = tmp_path / driver
        folder.mkdir()
        more = {"PROFILE": "BASELINE"} if driver == "GTiff" else {}
        rasterio.shutil.copy(flat, folder / name, driver=driver, **more)
        (folder / f"{name}.aux.xml").unlink(missing_ok=True)
        (folder / name).with_suffix(sidecar).write_text("\n".join(map(repr, world)))
        if system == "prj":
            text = pyproj.CRS("EPSG:2154").to_wkt("WKT1_ESRI")
            (folder / name).with_suffix(".prj").write_text(text)
        pixels = read(folder, 190)
        np.testing.assert_array_equal(pixels.valid, whole.valid)
        off = np.abs(pixels.rgb.astype(int) - whole.rgb)
        assert off.mean() < (4 if driver == "JPEG" else 0.1)


@pytest.mark.parametrize("driver, suffix", [("MBTiles", ".mbtiles"), ("GPKG", ".gpkg")])
def test_tile_stores_are_read_at_their_finest(tmp_path, driver, suffix):
    if suffix[1:] not in raster_driver_extensions():
        pytest.skip(f"this GDAL has no {driver} driver")
    scene = smooth_scene(700)
    source = write(
        tmp_path / "a.tif", scene, crs="EPSG:3857", transform=placed("EPSG:3857", size=700)
    )
    path = tmp_path / "store" / f"2020{suffix}"
    path.parent.mkdir()
    rasterio.shutil.copy(source, path, driver=driver, TILE_FORMAT="PNG")
    with rasterio.open(path, "r+") as data:
        data.build_overviews([2, 4])
    mosaic = Mosaic.open([path.parent])
    (store,) = mosaic.sources
    assert store.gsd_m < 1.1 and store.date == "2020" and store.bands == (1, 2, 3)
    one, other = read(source, 300), read(path.parent, 300)
    assert other.valid.all()
    off = np.abs(one.rgb.astype(int) - other.rgb)
    assert off.mean() < 6  # GDAL resamples into the store's own zoom levels


@pytest.mark.parametrize("stated", [True, False])
def test_rows_of_tiles_that_count_from_the_north(tmp_path, stated):
    if "mbtiles" not in raster_driver_extensions():
        pytest.skip("this GDAL has no MBTiles driver")
    transform = placed("EPSG:3857", size=200)
    source = write(tmp_path / "a.tif", SCENE, crs="EPSG:3857", transform=transform)
    path = tmp_path / "a.mbtiles"
    rasterio.shutil.copy(source, path, driver="MBTiles")
    with closing(sqlite3.connect(path)) as store, store:
        store.execute("UPDATE tiles SET tile_row = tile_row - (1 << zoom_level)")
        store.execute("UPDATE tiles SET tile_row = -1 - tile_row")
        if stated:
            store.execute("INSERT INTO metadata VALUES ('scheme', 'xyz')")
    with pytest.raises(ImageryError, match=r"north \(xyz\).*scheme tms"):
        Mosaic.open([path])


def test_transparent_colours_of_a_palette_are_missing_pixels(tmp_path):
    scene = (np.arange(200 * 200).reshape(1, 200, 200) // 100 % 4).astype(np.uint8)
    colours = {0: (9, 9, 9, 0), 1: (9, 90, 9, 0), 2: (0, 100, 0, 255), 3: (40, 40, 240, 255)}
    profile = {"count": 1, "height": 200, "width": 200, "dtype": "uint8", "crs": "EPSG:2154"}
    with rasterio.open("/vsimem/a", "w", "MEM", transform=placed(size=200), **profile) as data:
        data.write(scene)
        data.write_colormap(1, colours)
        rasterio.shutil.copy(data, tmp_path / "a.png", driver="PNG")
    pixels = read(tmp_path / "a.png", 150)
    assert 0.4 < pixels.valid.mean() < 0.6
    assert set(map(tuple, pixels.rgb[pixels.valid][:, :2].tolist())) <= {(0, 100), (40, 40)}


@pytest.mark.long
def test_build_from_a_folder(run, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    whole = write(tmp_path / "whole.tif", SCENE, transform=placed(size=200))
    tiles(tmp_path / "ortho_2019")
    found = []
    for ortho, said in ((tmp_path / "ortho_2019", "4 files"), (whole, "whole.tif")):
        out = tmp_path / f"{ortho.stem}.onav"
        more = ("--tile-px", 64, "--overlap", 0.5, "--workers", 2)
        assert said in run("build", "--ortho", ortho, *more, "--out", out).out
        found.append(open_map(out))
    (entry,) = found[0].manifest.imagery
    assert (entry["name"], entry["date"], entry["files"]) == ("ortho_2019", "2019", 4)
    first, second = (each.arrays["sheet0/embeddings"].astype(float) for each in found)
    assert np.einsum("nd,nd->n", first, second).min() > 0.99
