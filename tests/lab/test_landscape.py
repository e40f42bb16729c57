from pathlib import Path

import cv2
import numpy as np
import pytest
from lab.landscape import DEFAULT_DATES, ORIGIN_M, OTHER_LIGHT, Landscape, Look, generate_area
from lab.landscape.__main__ import main
from lab.landscape.noise import fractal_grid, key_of
from lab.landscape.relief import lighting
from lab.landscape.window import PixelWindow
from numpy.typing import NDArray

SUMMER, AUTUMN, SPRING = DEFAULT_DATES
IN_LIGHT = {each.look: each for each in OTHER_LIGHT}
WEST_M, NORTH_M = ORIGIN_M[0] + 600.0, ORIGIN_M[1] + 1500.0


def worst_difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[int, float]:
    """Largest difference in grey levels, and the share of values that differ at all."""
    difference = np.abs(a.astype(int) - b.astype(int))
    return int(difference.max()), float((difference > 0).mean())


def oriented_gradients(image: NDArray[np.uint8]) -> NDArray[np.complex64]:
    grey = cv2.GaussianBlur(image.astype(np.float32).mean(axis=2), (0, 0), 1.5)
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    size = np.abs(gradient)
    turned = gradient**2 / np.maximum(size**2, 1e-9)
    return (turned * size / (size + np.median(size))).astype(np.complex64)


@pytest.fixture(scope="module")
def pair() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    land = Landscape(1)
    summer, autumn = (land.render(d, WEST_M, NORTH_M, 400, 360, 1.0) for d in (SUMMER, AUTUMN))
    return summer, autumn


def test_same_seed_same_pixels_in_any_order_of_rendering(pair):
    land = Landscape(1)
    land.render(AUTUMN, WEST_M + 9000.0, NORTH_M, 16, 16, 1.0)
    again = land.render(SUMMER, WEST_M, NORTH_M, 400, 360, 1.0)
    assert again.dtype == np.uint8 and again.shape == (360, 400, 3)
    assert np.array_equal(again, pair[0])
    other = Landscape(2).render(SUMMER, WEST_M, NORTH_M, 400, 360, 1.0)
    assert np.abs(other.astype(int) - pair[0]).mean() > 15


@pytest.mark.parametrize(
    ("gsd_m", "date", "corner_m"),
    [
        (1.0, AUTUMN, (WEST_M, NORTH_M)),
        pytest.param(0.3, SUMMER, (WEST_M + 700.1, NORTH_M + 0.25), marks=pytest.mark.slow),
        pytest.param(0.7, SPRING, (WEST_M - 40000.3, NORTH_M + 30000.7), marks=pytest.mark.slow),
        (3.0, SPRING, (WEST_M - 500.0, NORTH_M + 300.0)),
        (1.0, IN_LIGHT[Look.NIGHT], (WEST_M, NORTH_M)),  # with light of lamps beyond the border
        pytest.param(1.0, IN_LIGHT[Look.DAWN], (WEST_M, NORTH_M), marks=pytest.mark.slow),
    ],
)
def test_quarters_meet_without_seam(gsd_m, date, corner_m):
    land = Landscape(1)
    west_m, north_m = corner_m
    shape = (201, 170) if gsd_m < 2.0 else (101, 90)
    split = (90, 71) if gsd_m < 2.0 else (40, 31)
    whole = land.render(date, west_m, north_m, *shape, gsd_m)
    joined, other = np.empty_like(whole), Landscape(1)
    for col, width in ((0, split[0]), (split[0], shape[0] - split[0])):
        for row, height in ((0, split[1]), (split[1], shape[1] - split[1])):
            joined[row : row + height, col : col + width] = other.render(
                date, west_m + col * gsd_m, north_m - row * gsd_m, width, height, gsd_m
            )
    largest, share = worst_difference(whole, joined)
    assert largest <= 2
    assert share < 1e-3


def test_dates_differ_but_edges_stay_in_place(pair):
    summer, autumn = pair
    assert np.abs(summer.astype(int) - autumn).mean() > 15
    a, b = oriented_gradients(summer), oriented_gradients(autumn)
    correlation = np.fft.ifft2(np.fft.fft2(a) * np.conj(np.fft.fft2(b))).real
    row, col = np.unravel_index(correlation.argmax(), correlation.shape)
    assert min(row, 360 - row) <= 1
    assert min(col, 400 - col) <= 1


def test_other_light_keeps_edges_and_not_their_contrast(pair):
    land = Landscape(1)

    def seen(look):
        return land.render(IN_LIGHT[look], WEST_M, NORTH_M, 400, 360, 1.0)

    def alike(look):
        """Correlation of edge directions, and of grey levels, with those of a summer's day."""
        edges, by_day = (oriented_gradients(each).ravel() for each in (seen(look), pair[0]))
        levels = [each.astype(np.float32).mean(axis=2).ravel() for each in (seen(look), pair[0])]
        product = np.vdot(edges, by_day).real / (np.linalg.norm(edges) * np.linalg.norm(by_day))
        return product, np.corrcoef(levels)[0, 1]

    assert set(IN_LIGHT) == set(Look) - {Look.COLOUR}
    for look in (Look.NEAR_INFRARED, Look.THERMAL, Look.DAWN):
        edges, levels = alike(look)
        assert edges > 0.15 and levels < 0.5, look
    assert alike(Look.BARE)[0] > 0.1
    snow, night = seen(Look.SNOW), seen(Look.NIGHT)
    assert np.median(snow) > 215 and np.median(night) < 25 and np.percentile(night, 99) > 60


@pytest.mark.parametrize("gsd_m", [0.5, 1.0])
@pytest.mark.parametrize("date", DEFAULT_DATES)
def test_shadow_lies_away_from_the_sun_and_is_as_long_as_it_should_be(date, gsd_m):
    size, height_m = int(120 / gsd_m), 12.0
    window = PixelWindow.at(0.0, 0.0, size, size, gsd_m)
    height = np.zeros((size, size), np.float32)
    post = slice(size // 2 - 2, size // 2 + 2)
    height[post, post] = height_m
    dark = lighting(height, np.zeros((size, size), np.uint8), window, date) < 0.5
    dark[post, post] = False
    rows, cols = np.nonzero(dark)
    east_m, north_m = (cols + 0.5 - size / 2) * gsd_m, (size / 2 - rows - 0.5) * gsd_m
    length_m = np.hypot(east_m, north_m).max()
    expected_m = height_m / np.tan(np.deg2rad(date.sun_elevation_deg))
    assert abs(length_m - expected_m) < 2.0 + 3.0 * gsd_m
    bearing_deg = np.rad2deg(np.arctan2(east_m.mean(), north_m.mean()))
    assert abs((bearing_deg - date.sun_azimuth_deg) % 360.0 - 180.0) < 6.0


@pytest.mark.parametrize("gsd_m", [0.2, 0.3, 0.7, 1.3])
def test_octaves_at_the_edge_of_resolution_do_not_hang_on_the_window(gsd_m):
    columns = np.arange(1285, 2100)
    east_m, north_m = (columns + 0.5) * gsd_m + 0.50001, np.array([3.0, 2.0])
    octaves = (4.0 * gsd_m, 2.0 * gsd_m)
    whole = fractal_grid(key_of("edge"), east_m, north_m, octaves)
    for start in range(1, 800, 57):
        part = fractal_grid(key_of("edge"), east_m[start:], north_m, octaves)
        np.testing.assert_allclose(part, whole[:, start:], atol=1e-5)


@pytest.mark.long
def test_geotiff_has_position_and_date(tmp_path: Path):
    import rasterio

    size_m, dates = (250.0, 150.0), DEFAULT_DATES[:2]
    paths = generate_area(tmp_path / "area", size_m=size_m, gsd_m=2.0, dates=dates)
    assert [path.name for path in paths] == ["2016-07.tif", "2021-10.tif"]
    assert sorted(tmp_path.glob("area/*")) == sorted(paths)  # nothing temporary left
    with rasterio.open(paths[0]) as image:
        assert image.crs.to_epsg() == 2154
        assert (image.width, image.height, image.count) == (125, 75, 3)
        assert image.dtypes == ("uint8",) * 3
        assert image.transform.a == 2.0
        assert image.bounds == (652000.0, 6862000.0, 652250.0, 6862150.0)
        assert image.tags()["TIFFTAG_DATETIME"] == "2016:07:12 12:00:00"
        assert [band.name for band in image.colorinterp] == ["red", "green", "blue"]
        assert image.profile["compress"] == "deflate"
        pixels = np.moveaxis(image.read(), 0, 2)
    assert np.array_equal(pixels, Landscape(1).render(SUMMER, 652000.0, 6862150.0, 125, 75, 2.0))


def test_the_command_writes_three_dates(tmp_path: Path, capsys):
    out = tmp_path / "area"
    main(["--out", str(out), "--size-m", "120", "100", "--gsd-m", "2"])
    printed = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert sorted(printed) == sorted(out.iterdir()) and len(printed) == 3
    main(["--out", str(out), "--size-m", "120", "100", "--gsd-m", "2", "--other-light"])
    assert {f"{each.name}.tif" for each in OTHER_LIGHT} < {each.name for each in out.iterdir()}
    with pytest.raises(SystemExit, match="error: size_m must be"):
        main(["--out", str(tmp_path / "no"), "--size-m", "-5", "5"])
    assert not (tmp_path / "no").exists()
