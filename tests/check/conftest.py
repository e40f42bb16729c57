"""A small map of which the west shows a landscape and the east nothing, at two dates."""

from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from lab.landscape import DEFAULT_DATES, generate_area

from orthonav.core.mapfile import open_map
from orthonav.ground.build import BuildRequest, build_map


def blank_east(path, seed):
    """Bare ground with noise over the eastern half of an orthophoto."""
    with rasterio.open(path) as data:
        rgb, profile = data.read(), data.profile
    east = np.s_[:, :, rgb.shape[2] // 2 :]
    noise = np.random.default_rng(seed).normal(120, 3, rgb[east].shape)
    rgb[east] = np.clip(noise, 0, 255).astype(np.uint8)
    with rasterio.open(path, "w", **profile) as data:
        data.write(rgb)


@pytest.fixture(scope="session")
def half_blank(made_once):
    """Paths `past`, `present` of orthophotos of 900 x 600 m at 1 m and `map` of the first."""

    def make(folder):
        dates = generate_area(folder, size_m=(900.0, 600.0), dates=DEFAULT_DATES[:2], seed=2)
        for seed, path in enumerate(dates):
            blank_east(path, seed)
        out = folder / "half.onav"
        request = BuildRequest(dates[:1], out, tile_px=128, overlap=0.75, calibration_views=10)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("orthonav.ground.build.calibrate.CROPS", 48)
            patch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 4)
            build_map(request)

    folder = made_once("half-blank", make)
    past, present = sorted(folder.glob("*.tif"))
    return SimpleNamespace(past=past, present=present, map=folder / "half.onav")


@pytest.fixture(scope="module")
def opened(half_blank):
    return open_map(half_blank.map)


@pytest.fixture(scope="module")
def frame(opened):
    return opened.manifest.sheets[0].frame
