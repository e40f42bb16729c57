"""Views on a map whose ground is known everywhere: found to a fraction of a pixel, or refused."""

import math
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from blots import (
    AGL_M,
    CAMERA,
    GROUND,
    Ground,
    as_grey,
    error_m,
    place_of,
    planned,
    prior_at,
    rendered,
)

from orthonav.core.localize import Localizer
from orthonav.core.localize.place import CandidateRefiner
from orthonav.core.localize.plan import ClearMargin
from orthonav.core.mapfile import GreyLayer, open_map, write_map
from orthonav.core.mapfile.layer import part_names
from orthonav.core.records import CONFIDENT, Fix, NoFix, Prior, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.onboard.run import SingleViews, locate_view

NEVER_CLEAR = ClearMargin(1e9, 1e9, 1e9)
NOT_AT_FINAL = ClearMargin(0.0, 0.0, 1e9)
EVIDENCE = {"score", "strength", "rival", "look", "look_rival", "peak_ratio", "look_ratio"}
EVIDENCE |= {"gradient_correlation", "grey_correlation", "agreement", "overlap", "candidates"}


@pytest.fixture(scope="module")
def map_path(known):
    return known.path


@pytest.fixture(scope="module")
def localizer(map_path, known):
    made = Localizer(open_map(map_path))
    offset = made.sheet.frame.en_from_latlon(known.frame.lat_deg, known.frame.lon_deg)
    assert made.registration is not None and np.hypot(*offset) < 1e-3
    return made


def turned_deg(one, other):
    return (one - other + 180) % 360 - 180


def telemetry(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0, agl_m=AGL_M, **more):
    return Telemetry(0, yaw_deg, pitch_deg, roll_deg, agl_m, **more)


def located(
    localizer, place_en_m, attitude=(0.0, 0.0, 0.0), camera=CAMERA, agl_m=AGL_M, **keywords
):
    """Where a view is placed whose telemetry is right."""
    grey = rendered(GROUND, place_en_m, attitude, agl_m, camera)
    exact = telemetry(*attitude, agl_m, tilt_std_deg=0.0)
    return localizer.locate(View(grey, camera, exact), **keywords)


PLACES = [(-120.0, 95.0), (60.3, -110.7), (133.1, 140.2), (-30.0, 5.5), (10.0, -80.0)]
HEADINGS = [0.0, 77.0, 181.0, -100.0, 290.0]


class Plain(NamedTuple):
    """A view like any other, its place and its fix."""

    view: View
    place: np.ndarray
    fix: Fix

    def reported(self, **changes):
        return replace(self.view, telemetry=replace(self.view.telemetry, **changes))


@pytest.fixture(scope="module")
def plain(localizer):
    place = np.array([40.0, -25.0])
    view = View(rendered(GROUND, place, (33.0, 0.0, 0.0)), CAMERA, telemetry(33.0))
    return Plain(view, place, localizer.locate(view))


@pytest.mark.parametrize("place, yaw_deg", list(zip(PLACES, HEADINGS, strict=True)))
def test_a_view_is_placed_to_a_fraction_of_a_pixel(localizer, place, yaw_deg):
    """Heading and height are estimated, although the reported ones are wrong."""
    rng = np.random.default_rng(abs(int(yaw_deg)))
    agl_m = AGL_M * rng.uniform(0.85, 1.15)
    grey = rendered(GROUND, place, (yaw_deg, 0, 0), agl_m)
    agl = {"agl_m": agl_m * rng.normal(1, 0.04), "tilt_std_deg": 0.0}
    reported = telemetry(yaw_deg + rng.normal(0, 4), **agl)
    fix = localizer.locate(View(grey, CAMERA, reported))
    assert error_m(localizer, fix, place) < 0.1
    assert abs(turned_deg(fix.heading_deg, yaw_deg)) < 0.1 and 0 <= fix.heading_deg < 360
    assert fix.agl_m == pytest.approx(agl_m, rel=0.003)
    assert fix.confidence > 0.9 and fix.evidence["score"] > 0.85


def test_a_fix_states_its_evidence(localizer, plain):
    fix = plain.fix
    assert set(fix.evidence) >= EVIDENCE and fix.radius_m == localizer.registration.radius_m
    assert all(math.isfinite(fix.evidence[name]) for name in EVIDENCE)
    assert fix.evidence["overlap"] == pytest.approx(1) and fix.evidence["agreement"] > 0.9
    assert fix.evidence["strength"] > fix.evidence["rival"] > 0
    with pytest.raises(TypeError):
        fix.evidence["score"] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        fix.cov_en_m2[0, 0] = 0.0


@pytest.mark.parametrize("yaw_deg", [0, 90, 45, -45])
def test_motion_blur_displaces_within_the_covariance(map_path, yaw_deg):
    """The blur makes two edges of one, 2.5 m to either side along it."""
    exact = Localizer(open_map(map_path))
    exact.registration.floor_px = 0.0
    grey = cv2.blur(rendered(GROUND, (0.0, 0.0), (yaw_deg, 0.0, 0.0)), (1, 25))
    for known in ({"tilt_std_deg": 0.0}, {}):
        fix = exact.locate(View(grey, CAMERA, telemetry(float(yaw_deg), **known)))
        off = place_of(exact, fix)
        assert off @ np.linalg.solve(fix.cov_en_m2, off) < 9
        assert known == {} or np.hypot(*off) < 0.5


@pytest.mark.parametrize("attitude", [(0, 10, -8), (75, 10, -8), (200, -12, 9), (310, 0, 20)])
def test_the_position_is_that_of_the_camera(localizer, attitude):
    """Not of what it looks at, which lies up to 55 m away."""
    attitude = tuple(map(float, attitude))
    place = np.array([-20.0, 30.0])
    fix = located(localizer, place, attitude)
    assert error_m(localizer, fix, place) < 0.15
    assert abs(turned_deg(fix.heading_deg, attitude[0])) < 0.1
    assert fix.agl_m == pytest.approx(AGL_M, rel=0.002)


@pytest.mark.parametrize("yaw_deg", [3.0, pytest.param(125.0, marks=pytest.mark.slow), 257.0])
def test_unknown_heading(localizer, yaw_deg):
    place = np.array([-60.0, 50.0])
    reported = telemetry(math.nan, 5.0, -4.0, tilt_std_deg=0.0)
    view = View(rendered(GROUND, place, (yaw_deg, 5.0, -4.0)), CAMERA, reported)
    fix = localizer.locate(view, heading_known=False)
    assert error_m(localizer, fix, place) < 0.15 and fix.confidence > 0.9
    assert abs(turned_deg(fix.heading_deg, yaw_deg)) < 0.1
    refused = localizer.locate(view)
    assert isinstance(refused, NoFix) and refused.reason == "missing_telemetry"
    near = localizer.locate(view, heading_known=False, prior=prior_at(localizer, place, 20.0))
    assert error_m(localizer, near, place) < 0.15


def test_a_map_too_large_to_be_searched_whole_needs_a_prior(localizer, plain, monkeypatch):
    """Memory has a bound: by tiles if views are as large, else not at all."""
    registration, asked = localizer.registration, []
    rows, cols = registration.pyramid.shape(0)
    whole = registration.windows.whole
    monkeypatch.setattr(registration, "plan", planned(max_search_px=40_000))
    monkeypatch.setattr(
        registration.windows, "whole", lambda *view: asked.append(view[0].level) or whole(*view)
    )
    alone = localizer.locate(plain.view)
    assert not [level for level in asked if (rows >> level) * (cols >> level) > 40_000]
    assert isinstance(alone, Fix) or (alone.reason == "no_match" and "prior" in alone.detail)
    fix = localizer.locate(plain.view, prior=prior_at(localizer, plain.place, 5.0))
    assert place_of(localizer, fix) == pytest.approx(place_of(localizer, plain.fix), abs=0.1)
    monkeypatch.setattr(registration, "propose", None)
    monkeypatch.setattr(registration, "plan", planned(max_search_px=100))
    nothing = localizer.locate(plain.view)
    assert nothing.reason == "no_match" and "prior" in nothing.detail


def test_a_view_is_found_by_tiles_alone(localizer, plain, monkeypatch):
    """The plan allows no search by FFT."""
    plan = planned(max_search_px=100, tile_candidates=(40, 80))
    monkeypatch.setattr(localizer.registration, "plan", plan)
    refine, candidates = CandidateRefiner.to_mid_level, []

    def noted(refiner, poses, *more):
        candidates.extend(poses)
        return refine(refiner, poses, *more)

    monkeypatch.setattr(CandidateRefiner, "to_mid_level", noted)
    fix = localizer.locate(plain.view)
    assert place_of(localizer, fix) == pytest.approx(place_of(localizer, plain.fix), abs=0.1)
    assert len(candidates) > 5


@pytest.mark.parametrize(("off_m", "found"), [((16.0, -14.0), True), ((72.0, 0.0), False)])
def test_by_tiles_too_a_view_is_found_within_its_prior_only(
    localizer, plain, monkeypatch, off_m, found
):
    """Of places near the allowed tiles, up to 65 m farther, some are beyond it."""
    plan = planned(max_search_px=100, tile_candidates=(40, 80))
    monkeypatch.setattr(localizer.registration, "plan", plan)
    prior = prior_at(localizer, plain.place + off_m, 10.0)
    fix = localizer.locate(plain.view, prior=prior)
    assert (isinstance(fix, Fix) and error_m(localizer, fix, plain.place) < 0.5) == found


def test_the_prior_is_that_of_the_aircraft_not_of_the_ground_seen(localizer):
    place = np.array([-20.0, -60.0])
    grey = rendered(GROUND, place, (45.0, 30.0, 0.0))
    reported = telemetry(45.0, 30.0, yaw_std_deg=1.0)
    prior = prior_at(localizer, place, 2.0)
    for known in (True, False):
        fix = localizer.locate(View(grey, CAMERA, reported), prior=prior, heading_known=known)
        assert error_m(localizer, fix, place) < 0.3


@pytest.mark.parametrize("away_en_m", [(50_000.0, 0.0), (0.0, -3000.0), (-900.0, 900.0)])
def test_a_prior_outside_is_outside_the_map(localizer, plain, away_en_m):
    outcome = localizer.locate(plain.view, prior=prior_at(localizer, away_en_m, 100.0))
    assert isinstance(outcome, NoFix) and outcome.reason == "outside_map"


@pytest.mark.parametrize("place", [(-300.0, 60.0), (40.0, 302.0), (290.0, -10.0)])
def test_a_view_half_outside_is_found(localizer, place):
    """Half of what it sees is on the map, and that is enough."""
    fix = located(localizer, np.array(place), (10.0, 0.0, 0.0))
    assert error_m(localizer, fix, place) < 0.4
    assert 0.4 < fix.evidence["overlap"] < 0.7 and fix.evidence["agreement"] > 0.9


def noise(blur_px):
    grey = np.random.default_rng(0).normal(size=(240, 320)).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    return as_grey(128 + 40 * grey / grey.std())


def mirrored(place_en_m):
    return np.ascontiguousarray(rendered(GROUND, place_en_m, (33.0, 0.0, 0.0))[:, ::-1])


NEGATIVES = {
    "another place": lambda: rendered(Ground(5, 200.0), (0.0, 0.0), (33.0, 0.0, 0.0)),
    "a third place": lambda: rendered(Ground(6, 200.0), (20.0, 0.0), (33.0, 0.0, 0.0)),
    "fine noise": lambda: noise(0.5),
    "coarse noise": lambda: noise(4.0),
    "mirrored": lambda: mirrored((40.0, -25.0)),
    "mirrored too": lambda: mirrored((-100.0, 60.0)),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "name, heading_known", [*((name, True) for name in NEGATIVES), ("another place", False)]
)
def test_negatives_have_low_confidence(localizer, name, heading_known):
    reported = telemetry(33.0)
    outcome = localizer.locate(
        View(NEGATIVES[name](), CAMERA, reported), heading_known=heading_known
    )
    assert isinstance(outcome, NoFix) or outcome.confidence < 0.5


def same(one, other):
    assert type(one) is type(other)
    if isinstance(one, NoFix):
        return (one.reason, one.detail) == (other.reason, other.detail)
    values = [
        (f.lat_deg, f.lon_deg, f.confidence, f.heading_deg, f.agl_m, str(dict(f.evidence)))
        for f in (one, other)
    ]
    return values[0] == values[1] and (one.cov_en_m2 == other.cov_en_m2).all()


def test_a_narrow_prior_does_not_raise_the_confidence_of_negatives(localizer):
    """With hardly any place to choose from, a wrong one does not look right."""
    for place in ((40.0, -25.0), (-100.0, 60.0)):
        prior = prior_at(localizer, np.array(place), 3.0)
        outcome = localizer.locate(View(mirrored(place), CAMERA, telemetry(33.0)), prior=prior)
        assert isinstance(outcome, NoFix) or outcome.confidence < 0.7


def test_threads_within_a_view_change_nothing(localizer, map_path, plain):
    threaded = Localizer(open_map(map_path), plan=planned(threads=3))
    assert same(*(each.locate(plain.view, heading_known=False) for each in (localizer, threaded)))


def test_a_spent_budget_leaves_the_best_place_so_far(map_path, plain):
    """One that ends before the first search does, so that only this one is made. No margin is
    enough to end the search here, and such a place is not confident."""
    doubting = planned(clear=NEVER_CLEAR, clear_at_mid=NEVER_CLEAR)
    whole, fix = (
        Localizer(open_map(map_path), plan=plan).locate(plain.view)
        for plan in (doubting, replace(doubting, budget_ms=1e-6))
    )
    assert isinstance(whole, Fix) and isinstance(fix, Fix)
    assert fix.evidence["candidates"] < whole.evidence["candidates"]
    assert "cut_short" not in whole.evidence and fix.evidence["cut_short"] == 1
    assert whole.confidence > CONFIDENT > fix.confidence


@pytest.mark.parametrize("margin", [NEVER_CLEAR, NOT_AT_FINAL], ids=["mid", "final"])
def test_a_search_goes_on_until_a_place_stands_out_or_a_trial_proves_it(map_path, plain, margin):
    """The place of this view stands out at the first stage already."""
    doubting = planned(clear=margin, clear_at_mid=margin)
    whole, proven = (
        Localizer(open_map(map_path), plan=plan).locate(plain.view)
        for plan in (doubting, replace(doubting, trial_ms=0.0))
    )
    first = plain.fix.evidence["candidates"]
    assert whole.evidence["candidates"] > 3 * first == 3 * proven.evidence["candidates"]
    assert proven.confidence == pytest.approx(whole.confidence, abs=1e-3)


def test_threads_may_share_a_localizer(localizer, map_path):
    views = [
        View(rendered(GROUND, place, (yaw, 4.0, 0.0)), CAMERA, telemetry(yaw + 2, 4.0))
        for place, yaw in zip(PLACES[:4], HEADINGS[:4], strict=True)
    ]
    with ThreadPoolExecutor(2) as pool:
        shared = list(pool.map(Localizer(open_map(map_path)).locate, views))
    assert all(same(localizer.locate(view), fix) for view, fix in zip(views, shared, strict=True))


def test_a_map_without_the_layer_is_flown_by_its_tiles(known, tmp_path, plain):
    path = tmp_path / "tiles.onav"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", 16)
        request = BuildRequest([known.ortho], path, tile_px=128, overlap=0.75, gsd_m=1.0)
        build_map(replace(request, registration=False))
    opened = open_map(path)
    assert GreyLayer.of(opened) is None and opened.manifest.registration is None
    made = Localizer(opened)
    assert made.registration is None
    fix = made.locate(plain.view)
    assert error_m(made, fix, plain.place) < made.grid.stride_m


def damaged(map_path, folder):
    """A copy of the map whose chunks hold no picture, but their sums are right."""
    opened = open_map(map_path)
    arrays = {name: np.array(part) for name, part in opened.arrays.items()}
    name = part_names(0)["bytes"]
    arrays[name] = np.zeros_like(arrays[name])
    shutil.copy(map_path, folder / "damaged.onav")
    write_map(folder / "damaged.onav", opened.manifest, arrays)
    return open_map(folder / "damaged.onav")


def test_a_damaged_layer_gives_no_fix(map_path, tmp_path, plain, caplog):
    broken = Localizer(damaged(map_path, tmp_path))
    outcome, latency_ms = locate_view(SingleViews(broken), plain.view)
    assert isinstance(outcome, NoFix) and outcome.reason == "map_damaged"
    assert "damaged" in outcome.detail and latency_ms > 0
    assert [record.exc_info for record in caplog.records] == [None]  # a line, no traceback


def test_a_swapped_prior_is_named(localizer, plain):
    lat_deg, lon_deg = localizer.opened.frame.latlon_from_en([0.0, 0.0])
    outcome = localizer.locate(plain.view, prior=Prior(lon_deg, lat_deg, 50))
    assert isinstance(outcome, NoFix) and outcome.reason == "outside_map"
    assert "seem to be swapped" in outcome.detail


ODD = {
    "heading std": {"yaw_std_deg": math.nan},
    "huge heading std": {"yaw_std_deg": 1e9},
    "negative heading std": {"yaw_std_deg": -5.0},
    "height std": {"agl_std_m": math.inf},
    "huge height std": {"agl_std_m": 1e9},
    "negative height std": {"agl_std_m": -20.0},
    "many turns": {"yaw_deg": 33.0 + 3600},
}


@pytest.mark.parametrize("changes", ODD.values(), ids=ODD.keys())
def test_invalid_deviations_are_tolerated(localizer, plain, changes):
    fix = localizer.locate(plain.reported(**changes))
    assert error_m(localizer, fix, plain.place) < 0.5 and 0 <= fix.heading_deg < 360
