"""Flights over houses and trees: views show them, heights above ground do not count them."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import route_of

from helpers import write_dem
from orthonav.core.errors import AreaError, FlightError, ImageryError
from orthonav.core.flight import open_flight
from orthonav.ground.imagery.terrain import open_dem

HOUSE_M, ROOF_M, AGL_M = 30.0, 8.0, 60.0


def slope(east_m, north_m):
    return 200.0 + 0.02 * (np.asarray(east_m) + np.asarray(north_m))


def town(east_m, north_m):
    """A house of `HOUSE_M` every 60 m on the slope: a quarter of the ground."""
    inside = (np.mod(east_m, 60.0) < HOUSE_M) & (np.mod(north_m, 60.0) < HOUSE_M)
    return slope(east_m, north_m) + np.where(inside, ROOF_M, 0.0)


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    return make_ortho(tmp_path_factory.mktemp("ortho") / "past.tif")


@pytest.fixture(scope="module")
def models(frame, tmp_path_factory):
    folder = tmp_path_factory.mktemp("heights")
    kinds = {"dsm": (town, 1.0), "dem": (slope, 10.0)}
    made = {
        name: write_dem(folder / f"{name}.tif", frame, heights, half_m=800.0, px_m=px_m)
        for name, (heights, px_m) in kinds.items()
    }
    return {name: open_dem(path, "msl") for name, path in made.items()}


@pytest.fixture
def over(fly):
    """Telemetry, true places and the rendered heights of a flight without its pictures."""

    def flown(**asked):
        flight, truth, made = fly(pictures=False, **{"agl_m": AGL_M, **asked})
        return [v.telemetry for v in flight.views], [*truth.values()], made[0][2]

    return flown


def near_middle(raster, heights):
    """Heights of a raster less the true ones, where it has samples on flat parts of both."""
    at = np.arange(-150.0, 150.0, 5.0) + 2.5
    east, north = np.meshgrid(at, at)
    return raster.at(east, north) - heights(east, north)


@pytest.mark.parametrize("known", [True, False], ids=["with a terrain", "lower envelope"])
def test_heights_count_from_the_ground_also_over_a_house(over, models, frame, known):
    terrain = models["dem"] if known else None
    flown = {"random": 12, "seed": 4, "surface": [models["dsm"]], "terrain": terrain}
    telemetry, places, seen = over(**flown)
    there = np.array([frame.en_from_latlon(*place) for place in places])
    assert (town(*there.T) > slope(*there.T) + 1).any()
    amsl_m = np.array([each.amsl_m for each in telemetry])
    np.testing.assert_allclose(amsl_m, slope(*there.T) + AGL_M, atol=0.5)
    assert np.isnan([each.agl_m for each in telemetry]).all()
    assert np.abs(near_middle(seen, town)).max() < 0.5
    if known:
        telemetry, _, seen = over(random=12, seed=4, terrain=terrain)
        assert [each.amsl_m for each in telemetry] == amsl_m.tolist()
        assert near_middle(seen, town).min() < -ROOF_M + 0.5


def test_the_altitude_of_a_route_counts_from_the_ground(over, models, frame):
    """It begins over a house."""
    route = route_of(frame, (10.0, 10.0), (130.0, 10.0))
    telemetry, _, _ = over(route=route, surface=[models["dsm"]])
    amsl_m = [each.amsl_m for each in telemetry]
    np.testing.assert_allclose(amsl_m, slope(10.0, 10.0) + AGL_M, atol=0.5)


def test_earlier_models_come_first_and_the_terrain_fills_holes(over, models, frame, tmp_path):
    def western(heights):
        heights[:, heights.shape[1] // 2 :] = -9999
        return heights

    west = open_dem(write_dem(tmp_path / "w.tif", frame, town, 800.0, 1.0, western), "msl")
    raised = replace(models["dem"], gsd_m=1.0)
    for rest, heights in ((raised, slope), (models["dsm"], town)):
        seen = over(random=1, surface=[west, rest])[2]
        assert np.abs(near_middle(seen, heights)[:, 31:]).max() < 0.5
        assert np.abs(near_middle(seen, town)[:, :29]).max() < 0.5
    seen = over(random=1, surface=[west], terrain=models["dem"])[2]
    assert np.abs(near_middle(seen, slope)[:, 31:]).max() < 0.5


def test_flights_that_cannot_be(over, models, frame, tmp_path):
    surface = [models["dsm"]]
    route = route_of(frame, (0.0, 10.0), (40.0, 10.0))
    with pytest.raises(FlightError, match=r"view 1 is 5 m above ground, in a house or tree"):
        over(route=route, agl_m=5.0, surface=surface)
    with pytest.raises(ImageryError, match=r"every 10 m, which shows no houses"):
        over(random=1, surface=[models["dem"]])
    lower = write_dem(tmp_path / "deep.tif", frame, lambda *at: slope(*at) - 45.0, 800.0, 10.0)
    with pytest.raises(ImageryError, match="lies 45 m above the terrain"):
        over(random=1, surface=surface, terrain=open_dem(lower, "msl"))
    far = type(frame)(frame.lat_deg + 1.0, frame.lon_deg)
    away = open_dem(write_dem(tmp_path / "away.tif", far, town, 200.0, 1.0), "msl")
    with pytest.raises(AreaError, match="the surface does not reach to the imagery"):
        over(random=1, surface=[away], terrain=models["dem"])
    with pytest.raises(AreaError, match="no height below a view"):
        over(random=1, surface=[away])


def test_the_command(run, ortho, models, tmp_path):
    dsm, dem = (models[name].path for name in ("dsm", "dem"))
    fly = ("simulate", "--ortho", ortho, "--random", "1", "--agl-m", "60", "--surface", dsm)
    assert "vertical datum of the terrain file is not known" in run(*fly, "--out", "x").err
    out = ("--dem-datum", "msl", "--out", tmp_path / "f")
    assert run(*fly, *out).code == 0
    assert run(*fly, "--dem", dem, *out[:3], tmp_path / "g").code == 0
    heights = [open_flight(tmp_path / name).views[0].telemetry.amsl_m for name in "fg"]
    assert heights[0] == pytest.approx(heights[1], abs=0.5)
