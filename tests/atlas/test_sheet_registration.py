"""A view is registered on the part of a sheet around a place as on the whole sheet, on one sheet
where two overlap; and only the strongest candidates are searched."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("faiss", reason="without it an atlas has no index: orthonav[atlas]")

from orthonav.core.flight.folder import open_flight, read_truth
from orthonav.core.geo.frames import distances_m
from orthonav.core.records import PRIOR_SIGMAS, Prior, View
from orthonav.ground.atlas.locate import PlaceFinder, rectified
from orthonav.ground.atlas.search import SheetRegistrar, TileSearch, ViewRegistrar

SIDE_M = 300.0


@pytest.fixture
def registrar(atlas):
    return SheetRegistrar(atlas)


@pytest.fixture(scope="module")
def view(flown):
    flight = open_flight(flown)
    seen = next(iter(flight.views))
    return View(seen.grey(), flight.camera, seen.telemetry), next(
        iter(read_truth(flown / "truth.csv").values())
    )


@pytest.fixture(scope="module")
def candidate(atlas, view):
    finder = PlaceFinder(SheetRegistrar(atlas), TileSearch(atlas))
    found = finder._candidates(view[0], rectified(view[0], finder._search.recipe.gsd_m))
    return min(found, key=lambda each: _off_m(each, view[1]))


def _off_m(place, truth):
    return distances_m([place.latlon_deg], [truth])[0]


def test_a_part_of_a_sheet_has_the_match_of_the_whole_sheet(registrar, view, candidate):
    """The evidence is what confidences were fitted to."""
    seen, truth = view
    found = ViewRegistrar(registrar, seen, SIDE_M).searched(candidate)
    assert _off_m(found, truth) < 10
    sheet = registrar.at(candidate)
    yaw_deg, std_deg = np.degrees([candidate.turn_rad, candidate.turn_std_rad]).tolist()
    telemetry = replace(seen.telemetry, yaw_deg=yaw_deg, yaw_std_deg=std_deg)
    turned = replace(seen, telemetry=telemetry)
    prior = Prior(*candidate.latlon_deg, candidate.reach_m / PRIOR_SIGMAS)
    whole = sheet.search(turned, prior).run()
    for name in ("strength", "look", "detail_ratio", "local_phase", "local_gradients"):
        assert found.evidence[name] == pytest.approx(whole.scores[name], rel=0.05)
    assert found.turn_rad == pytest.approx(whole.pose.turn_rad, abs=2e-3)
    assert found.confidence == sheet.confidence


def test_all_views_of_a_flight_are_found(atlas, registrar, flown):
    finder = PlaceFinder(registrar, TileSearch(atlas))
    flight = open_flight(flown)
    truth = list(read_truth(flown / "truth.csv").values())
    for seen, at in zip(itertools.islice(flight.views, 3), truth, strict=False):
        finder.find(View(seen.grey(), flight.camera, seen.telemetry))
        assert _off_m(finder._agreement.best.last, at) < 25
