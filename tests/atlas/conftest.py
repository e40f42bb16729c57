"""An atlas with its index, and a flight over it in another year."""

import dataclasses
import shutil
import sys

import pytest

RECIPE = {"gsd_m": 2.5, "sheet_km": 2.0, "tile_px": 128, "calibration_views": 4}
COARSE = (5.0, 64, 0.875)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHONAV_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(autouse=True)
def no_memory_left():
    """An atlas at memory:// ends with its test."""
    yield
    if fsspec := sys.modules.get("fsspec"):
        fsspec.filesystem("memory").store.clear()


@pytest.fixture(params=["folder", "memory"])
def url(request, tmp_path):
    return {"folder": str(tmp_path / "atlas"), "memory": "memory://test/atlas"}[request.param]


@pytest.fixture(scope="module")
def crops():
    """Views from which a sheet is calibrated, which takes longest."""
    return 4


@pytest.fixture(scope="module", autouse=True)
def few_crops(crops):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", crops)
        if crops < 24:
            patch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 1)
        yield


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    return make_ortho(tmp_path_factory.mktemp("ortho") / "2019-06.tif")


@pytest.fixture(scope="module")
def atlas(area, made_once):
    from orthonav.ground.atlas.catalog import Atlas

    made = made_once("searched-atlas", lambda folder: build_searched(folder, [area.past]))
    return Atlas.open(made / "atlas")


@pytest.fixture(scope="module")
def twins(area, made_once):
    """An atlas with the same imagery at two places, 6 km apart."""
    import rasterio
    from affine import Affine

    from orthonav.ground.atlas.catalog import Atlas

    def make(folder):
        copy = shutil.copy(area.past, folder / area.past.name)
        with rasterio.open(copy, "r+") as moved:
            moved.transform = Affine.translation(6000.0, 0.0) * moved.transform
        build_searched(folder, [area.past, copy])

    return Atlas.open(made_once("twin-atlas", make) / "atlas")


def build_searched(folder, orthos):
    from orthonav.ground.atlas.build import AtlasRequest, build_atlas
    from orthonav.ground.atlas.catalog import CoarseRecipe
    from orthonav.ground.atlas.cluster import SerialRunner

    recipe = {**RECIPE, "coarse": dataclasses.asdict(CoarseRecipe(*COARSE))}
    with SerialRunner() as runner:
        request = AtlasRequest(str(folder / "atlas"), orthos, recipe)
        assert not build_atlas(request, runner).failed


@pytest.fixture(scope="module")
def flown(area, made_once):
    """A flight of five views across the second date, heading not reported; read-only."""
    from orthonav.ground.imagery.mosaic import Mosaic
    from orthonav.ground.planning.route import Route
    from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight

    def make(folder):
        outline = Mosaic.open([area.present]).outline_latlon_deg
        low, high = outline.min(axis=0), outline.max(axis=0)
        route = Route(tuple(tuple(low + share * (high - low)) for share in (0.33, 0.67)))
        request = SimulateRequest(
            [area.present],
            folder / "flight",
            route=route,
            spacing_m=130.0,
            agl_m=area.agl_m,
            camera=area.camera,
            errors=Errors(agl_std=0.03),
            seed=3,
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("orthonav.ground.simulate.ground.COVERAGE_PX", 256)
            simulate_flight(request)

    return made_once("searched-flight", make) / "flight"
