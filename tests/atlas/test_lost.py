"""Views are placed in an atlas of another year without a prior, and views of elsewhere are not."""

import dataclasses
import itertools
import json
import shutil

import cv2
import numpy as np
import pytest

from orthonav.atlas.build import AtlasRequest, build_atlas
from orthonav.atlas.catalog import Atlas
from orthonav.atlas.cluster import PlainRunner
from orthonav.atlas.ground import Ground
from orthonav.atlas.index import MANIFEST, IndexManifest, make_index, read_manifest, stale_sheets
from orthonav.atlas.lookup import AtlasLookup
from orthonav.atlas.lost import LostLocator, _against
from orthonav.atlas.recipe import CoarseRecipe
from orthonav.errors import AtlasError
from orthonav.flight.folder import open_flight
from orthonav.geo.frames import distances_m
from orthonav.geo.route import Route
from orthonav.imagery.mosaic import Mosaic
from orthonav.onboard.run import localize_flight, locate_view
from orthonav.records import Fix, NoFix, View
from orthonav.simulate.flight import Errors, SimulateRequest, simulate_flight

RECIPE = {
    "gsd_m": 2.5,
    "sheet_km": 2.0,
    "tile_px": 128,
    "calibration_views": 12,
    "coarse": dataclasses.asdict(CoarseRecipe(5.0, 64, 0.875)),
}


@pytest.fixture(autouse=True)
def fewer_places(monkeypatch):
    """Registering places takes longest."""
    monkeypatch.setattr("orthonav.atlas.lost.CANDIDATES", 8)


@pytest.fixture(scope="module")
def atlas(area, tmp_path_factory):
    """An atlas of the first date with its index; not to be changed."""
    place = tmp_path_factory.mktemp("lost") / "atlas"
    with PlainRunner() as runner:
        built = build_atlas(AtlasRequest(str(place), [area.past], RECIPE), runner)
    assert not built.failed
    return Atlas.open(place)


@pytest.fixture(scope="module")
def flown(area, tmp_path_factory):
    """A flight across the second date whose heading nobody knows."""
    south, north = _inner(area.present)
    request = SimulateRequest(
        [area.present],
        tmp_path_factory.mktemp("flown") / "flight",
        route=Route((south, north)),
        spacing_m=130.0,
        agl_m=area.agl_m,
        camera=area.camera,
        errors=Errors(agl_std=0.03),
        seed=3,
    )
    simulate_flight(request)
    return request.out


def _inner(ortho):
    """Two places well inside an orthophoto, from its south-west to its north-east."""
    outline = Mosaic.open([ortho]).outline_latlon_deg
    low, high = outline.min(axis=0), outline.max(axis=0)
    return tuple(low + 0.33 * (high - low)), tuple(low + 0.67 * (high - low))


def _truth(flown):
    lines = (flown / "truth.csv").read_text().splitlines()[1:]
    return {line.split(",")[0]: tuple(map(float, line.split(",")[1:3])) for line in lines}


def test_a_flight_is_found_without_prior_and_heading(atlas, flown):
    with AtlasLookup(atlas) as lookup:
        locator = LostLocator(Ground(atlas), lookup)
        results = list(localize_flight(locator, open_flight(flown)))
    truth = _truth(flown)
    assert isinstance(results[0].outcome, NoFix)  # one view alone never is
    assert results[0].outcome.reason == "searching"
    fixes = [each for each in results if isinstance(each.outcome, Fix)]
    assert len(fixes) >= len(results) - 3
    for each in fixes:
        place = (each.outcome.lat_deg, each.outcome.lon_deg)
        assert distances_m([place], [truth[each.frame]])[0] < 25
    assert fixes[-1].outcome.confidence > 0.9
    assert locator.state_name == "tracking"


def test_views_of_elsewhere_are_never_sure(atlas, flown):
    flight = open_flight(flown)
    with AtlasLookup(atlas) as lookup:
        locator = LostLocator(Ground(atlas), lookup)
        for view in itertools.islice(flight.views, 3):
            mirrored = np.ascontiguousarray(view.grey()[:, ::-1])
            outcome = locator.locate(View(mirrored, flight.camera, view.telemetry))
            assert not (isinstance(outcome, Fix) and outcome.confidence > 0.8)


def test_the_index_finds_what_comparing_all_tiles_finds(atlas, flown):
    flight = open_flight(flown)
    view = next(iter(flight.views))
    with AtlasLookup(atlas) as lookup:
        locator = LostLocator(Ground(atlas), lookup)
        found = {}
        for exact in (False, True):
            coarse = _coarse(view, flight, lookup)
            poses = [(turn, 0.0) for turn in np.arange(0, 2 * np.pi, 0.3)]
            found[exact] = lookup.candidates(coarse, poses, 10, exact=exact)
    assert locator.state_name == "searching"
    assert found[False][0].lat_deg == found[True][0].lat_deg
    common = {(c.lat_deg, c.lon_deg) for c in found[False]}
    common &= {(c.lat_deg, c.lon_deg) for c in found[True]}
    assert len(common) >= 9


def _coarse(view, flight, lookup):
    from orthonav.atlas.lost import _rectified

    return _rectified(View(view.grey(), flight.camera, view.telemetry), lookup.recipe.gsd_m)


def test_views_of_another_scale_are_refused_in_words(atlas, flown):
    flight = open_flight(flown)
    view = next(iter(flight.views))
    low = dataclasses.replace(view.telemetry, agl_m=60.0)
    with AtlasLookup(atlas) as lookup:
        outcome = LostLocator(Ground(atlas), lookup).locate(View(view.grey(), flight.camera, low))
    assert isinstance(outcome, NoFix)
    assert outcome.reason in {"wrong_scale", "too_small"}


def test_the_same_sheets_make_the_same_index(atlas, tmp_path):
    shutil.copytree(atlas.url, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "index")
    again = Atlas.open(tmp_path / "copy")
    make_index(again)
    names = sorted(atlas.store.names("index"))
    assert names == sorted(again.store.names("index"))
    for name in names:
        assert again.store.read(f"index/{name}") == atlas.store.read(f"index/{name}")


def test_a_sheet_that_goes_is_masked_and_one_that_comes_is_added(atlas, tmp_path, monkeypatch):
    monkeypatch.setattr("orthonav.atlas.index.FEW_ROWS", 0)
    monkeypatch.setattr("orthonav.atlas.index.ANEW_SHARE", 2.0)
    shutil.copytree(atlas.url, tmp_path / "copy")
    changed = Atlas.open(tmp_path / "copy")
    smallest = min(changed.sheets().values(), key=lambda each: each.tiles)
    kept = {key: changed.path(smallest, key) for key in smallest.assets}
    aside = {key: shutil.copy(path, tmp_path / path.name) for key, path in kept.items()}
    changed.retire(smallest.id)
    before = read_manifest(changed)
    assert stale_sheets(changed, before) == ([], [smallest.id])
    after = make_index(changed)
    assert smallest.id not in after.sheets
    assert [shard.name for shard in after.shards] == [shard.name for shard in before.shards]
    changed.put(smallest.id, aside, smallest)
    again = make_index(changed)
    assert len(again.shards) == len(before.shards) + 1
    assert stale_sheets(changed, again) == ([], [])
    with AtlasLookup(changed) as lookup:
        assert not lookup.unknown


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda plain: plain["shards"][0].update(name="../../../tmp/x"), "name"),
        (lambda plain: plain["shards"][0].update(base=-5), "shard"),
        (lambda plain: plain["shards"][0]["parts"][0].update(rows=2.5), "rows"),
        (lambda plain: _asset(plain).update(size_bytes="x"), "size"),
        (lambda plain: _asset(plain).update(sha256="../../../etc/passwd"), "sha256"),
        (lambda plain: plain.update(shards=7), "cannot be read"),
    ],
    ids=["name", "base", "rows", "size", "sha256", "shards"],
)
def test_an_index_of_a_stranger_is_checked(atlas, change, words):
    plain = json.loads(atlas.store.read(MANIFEST))
    change(plain)
    with pytest.raises(AtlasError, match=words):
        IndexManifest.from_json(json.dumps(plain).encode())


def _asset(plain):
    return plain["files"]["trained.safetensors"]


def test_no_index_and_a_damaged_one_are_named(atlas, tmp_path):
    shutil.copytree(atlas.url, tmp_path / "copy")
    damaged = Atlas.open(tmp_path / "copy")
    damaged.store.write(MANIFEST, b'{"format": "orthonav-index", "schema": 99}')
    with pytest.raises(AtlasError, match="schema 99"):
        AtlasLookup(damaged)
    damaged.store.remove(MANIFEST)
    with pytest.raises(AtlasError, match="orthonav atlas index"):
        AtlasLookup(damaged)
    assert make_index(damaged) is not None


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", ".hidden"])
def test_an_index_cannot_name_files_elsewhere(atlas, tmp_path, name):
    shutil.copytree(atlas.url, tmp_path / "copy")
    crafted = Atlas.open(tmp_path / "copy")
    plain = json.loads(crafted.store.read(MANIFEST))
    plain["files"][name] = plain["files"].pop("trained.safetensors")
    crafted.store.write(MANIFEST, json.dumps(plain).encode())
    with pytest.raises(AtlasError):
        AtlasLookup(crafted)


def evidence(**values):
    return {
        "strength": 50.0,
        "rival": 10.0,
        "look": 20.0,
        "look_rival": 5.0,
        "fine": np.nan,
        "fine_rival": np.nan,
        **values,
    }


def test_the_best_elsewhere_in_the_atlas_is_the_rival():
    found = _against(evidence(), [evidence(strength=30.0, look=4.0, fine=40.0)])
    assert found["rival"] == 30.0
    assert found["look_rival"] == 5.0
    assert np.isnan(found["fine_rival"])


def test_the_finest_level_does_not_speak_against_a_rival_not_looked_at_there():
    doubtful = evidence(strength=60.0, fine=90.0, fine_rival=20.0)
    found = _against(doubtful, [evidence(strength=60.0), evidence(strength=20.0, fine=30.0)])
    assert np.isnan(found["fine"]) and np.isnan(found["fine_rival"])
    both = _against(doubtful, [evidence(strength=60.0, fine=80.0)])
    assert (both["fine"], both["fine_rival"]) == (90.0, 80.0)


def test_localize_takes_an_atlas(atlas, flown, tmp_path, run):
    out = tmp_path / "fixes.jsonl"
    done = run("localize", "--atlas", atlas.url, flown, "--out", out, "--heading", "unknown")
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert lines[0]["status"] == "no_fix"
    assert lines[-1]["status"] == "fix"
    refused = run("localize", "--atlas", atlas.url, flown, "--out", out, "--track")
    assert refused.code == 1
    assert "--track" in refused.err


def test_telemetry_that_is_nonsense_ends_nothing(atlas, flown):
    flight = open_flight(flown)
    view = next(iter(flight.views))
    for change in (
        {"agl_m": np.nan},
        {"agl_m": -5.0},
        {"pitch_deg": 80.0},
        {"yaw_std_deg": -5.0, "yaw_deg": 10.0},
        {"tilt_std_deg": np.nan},
    ):
        telemetry = dataclasses.replace(view.telemetry, **change)
        with AtlasLookup(atlas) as lookup:
            locator = LostLocator(Ground(atlas), lookup, heading_known="yaw_std_deg" in change)
            outcome, _ = locate_view(locator, View(view.grey(), flight.camera, telemetry))
        assert isinstance(outcome, NoFix)
        assert outcome.reason != "internal_error"
        assert locator.state_name == "searching"


def test_blank_views_are_refused_and_end_nothing(atlas, flown):
    flight = open_flight(flown)
    view = next(iter(flight.views))
    grey = np.zeros_like(view.grey())
    with AtlasLookup(atlas) as lookup:
        locator = LostLocator(Ground(atlas), lookup)
        assert locator.locate(View(grey, flight.camera, view.telemetry)).reason == "too_dark"
        noise = cv2.randu(np.zeros_like(grey), 0, 255)
        assert isinstance(
            locator.locate(View(np.asarray(noise), flight.camera, view.telemetry)), NoFix
        )
