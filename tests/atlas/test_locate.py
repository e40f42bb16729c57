"""Views are located in an atlas of another year without a prior; negatives never are."""

import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

pytest.importorskip("faiss", reason="without it an atlas has no index: orthonav[atlas]")

from helpers import content
from orthonav.core.errors import AtlasError, MapFileError, StorageError
from orthonav.core.flight.folder import open_flight, read_truth
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.mapfile import open_map, write_map
from orthonav.core.records import Fix, NoFix, View
from orthonav.core.track import State
from orthonav.ground.atlas import locate
from orthonav.ground.atlas.catalog import Atlas, canonical
from orthonav.ground.atlas.index import (
    LEARNT,
    MANIFEST,
    IndexManifest,
    load_learnt,
    make_index,
    read_manifest,
    stale_sheets,
)
from orthonav.ground.atlas.locate import AtlasLocator, SheetSearch
from orthonav.onboard.run import locate_view

SILENT = NoFix("no_match", "shows nothing")


@pytest.fixture(scope="module")
def crops():
    return 24


@pytest.fixture(scope="module")
def search(atlas):
    return SheetSearch(atlas)


@pytest.fixture
def locator(search):
    return AtlasLocator(search)


@pytest.fixture(scope="module")
def views(flown):
    flight = open_flight(flown)
    return [View(view.grey(), flight.camera, view.telemetry) for view in flight.views]


@pytest.fixture(scope="module")
def places(flown):
    return list(read_truth(flown / "truth.csv").values())


@pytest.fixture
def copied(atlas, tmp_path):
    return Atlas.open(shutil.copytree(atlas.url, tmp_path / "copy"))


def error_m(fix, place):
    return distances_m([(fix.lat_deg, fix.lon_deg)], [place])[0]


def mirrored(view):
    return dataclasses.replace(view, grey=np.ascontiguousarray(view.grey[:, ::-1]))


@pytest.mark.long
def test_a_flight_is_located_without_prior_and_heading(atlas, flown, places, tmp_path, run):
    out = tmp_path / "fixes.jsonl"
    done = run("localize", atlas.url, flown, "--out", out, "--heading", "unknown")
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    # One view alone never gives a fix.
    assert (lines[0]["status"], lines[0]["reason"], lines[0]["state"]) == (
        *("no_fix", "searching", "searching"),
    )
    fixes = [line for line in lines if line["status"] == "fix"]
    assert len(fixes) >= len(lines) - 3
    along = LocalFrame(*places[0]).en_from_latlon(*places[-1])
    heading_deg = math.degrees(math.atan2(*along))  # views look along the route
    truth = read_truth(flown / "truth.csv")
    for fix in fixes:
        place = (fix["lat_deg"], fix["lon_deg"])
        assert distances_m([place], [truth[fix["frame"]]])[0] < 25
        assert abs((fix["heading_deg"] - heading_deg + 180) % 360 - 180) < 5
        assert fix["place_probability"] <= fix["evidence"]["recognized"]
        assert fix["state"] == "tracking"
    assert fixes[-1]["confidence"] > 0.9


@pytest.mark.parametrize("blind", ["another place", "no image"])
def test_a_position_needs_a_view_in_which_the_map_is_recognized(locator, views, places, blind):
    for view in views[:3]:
        fix = locator.locate(view)
    assert isinstance(fix, Fix) and error_m(fix, places[2]) < 25
    reason = NoFix("bad_image", "damaged")
    if blind == "no image":
        assert locator.passed(views[3].telemetry, reason) is reason
    else:
        assert isinstance(locator.locate(mirrored(views[3])), NoFix)
    assert locator.state_name in ("coasting", "lost")
    fix = locator.locate(views[4])
    assert isinstance(fix, Fix) and error_m(fix, places[4]) < 25
    assert locator.state_name == "tracking"


def test_a_track_continues_on_the_next_sheet(atlas, locator, views, places, monkeypatch):
    """Two sheets show the flight: it changes from one to the other, wherever the border is."""
    names = {sheet: index for index, sheet in enumerate(atlas.sheets())}
    first, other = names
    monkeypatch.setattr(locator._search, "sheets", lambda *_: [first])
    whole = locator._maps.open(max(names, key=lambda name: atlas.sheets()[name].tiles))
    monkeypatch.setattr(locator._maps, "open", lambda name: whole)
    for view in views[:3]:
        locator.locate(view)
    monkeypatch.setattr(locator._maps, "name_at", lambda *_: other)
    assert error_m(locator.locate(views[3]), places[3]) < 25
    assert [track.sheet for track in locator._tracks] == [other]


def test_a_track_that_is_lost_at_two_views_ends(locator, views, monkeypatch):
    locator.locate(views[0])
    monkeypatch.setattr(locator._search, "sheets", lambda *_: [])
    locator._state = State.TRACKING
    trackers = [track._tracker for track in locator._tracks]
    for state, left in ((State.COASTING, True), (State.LOST, True), (State.LOST, False)):
        for each in trackers:
            each.locate = lambda _, each=each, state=state: setattr(each, "state", state) or SILENT
        assert isinstance(locator.locate(views[1]), NoFix)
        assert bool(locator._tracks) == left
    assert locator.state_name == "lost"


def test_a_track_ends_where_the_aircraft_may_be_anywhere(locator, views, places, monkeypatch):
    """After a long gap one view, even where it is expected, is no fix."""
    for view in views[:3]:
        fix = locator.locate(view)
    assert error_m(fix, places[2]) < 25
    late = dataclasses.replace(views[3].telemetry, time_ns=views[3].telemetry.time_ns + 600 * 10**9)
    monkeypatch.setattr(locator._search, "sheets", lambda *_: [])
    assert isinstance(locator.locate(dataclasses.replace(views[3], telemetry=late)), NoFix)
    assert (locator.state_name, locator._tracks) == ("lost", [])


@pytest.mark.long
def test_no_sheet_is_believed_while_another_shows_the_same(twins, views):
    locator = AtlasLocator(SheetSearch(twins))
    assert [type(locator.locate(view)) for view in views] == [NoFix] * len(views)
    assert locator.state_name == "searching"


@pytest.mark.parametrize("lacks", ["its bytes", "a registration layer"])
def test_a_sheet_that_cannot_be_used_is_left_out(
    copied, views, tmp_path, caplog, monkeypatch, lacks
):
    sheet = next(iter(copied.sheets().values()))
    opened, path = open_map(copied.path(sheet)), tmp_path / "sheet.onav"
    parts = {name: part for name, part in opened.arrays.items() if "/grey" not in name}
    info = dataclasses.replace(opened.manifest.sheets[0], grey=None)
    bare = dataclasses.replace(opened.manifest, sheets=(info,), registration=None)
    write_map(path, bare, parts)
    if lacks == "its bytes":
        path.write_bytes(path.read_bytes()[:-1])
    monkeypatch.setattr(copied, "path", lambda _: path)
    outcome = AtlasLocator(SheetSearch(copied)).locate(views[0])
    assert outcome.reason == "searching" and "cannot be used" in caplog.text


def test_a_sheet_that_cannot_be_fetched_is_an_error(copied, views, monkeypatch):
    locator = AtlasLocator(SheetSearch(copied))

    def unreachable(_):
        raise StorageError("cannot read the atlas: timeout")

    monkeypatch.setattr(copied, "path", unreachable)
    with pytest.raises(StorageError, match="timeout"):
        locator.locate(views[0])


def test_a_track_on_a_damaged_sheet_ends(locator, views, monkeypatch):
    locator.locate(views[0])
    assert locator._tracks

    def damaged(*_):
        raise MapFileError("a chunk is damaged")

    monkeypatch.setattr(locate.SheetTrack, "locate", damaged)
    assert isinstance(locator.locate(views[1]), NoFix)
    assert not locator._tracks


def test_options_of_maps_are_refused(atlas, flown, tmp_path, run):
    refused = run("localize", atlas.url, flown, "--out", tmp_path / "fixes.jsonl", "--track")
    assert refused.code == 2 and "--track" in refused.err


@pytest.mark.long
def test_negatives_have_no_fix(locator, views):
    for view in views:
        assert isinstance(locator.locate(mirrored(view)), NoFix)
    assert locator.state_name == "searching"


@pytest.mark.parametrize(
    "change, reasons",
    [
        ({"agl_m": 60.0}, {"wrong_scale", "too_small"}),
        ({"agl_m": np.nan}, None),
        ({"yaw_std_deg": -5.0, "yaw_deg": 10.0}, None),
    ],
)
def test_other_scales_and_impossible_telemetry_give_a_reason(search, views, change, reasons):
    telemetry = dataclasses.replace(views[0].telemetry, **change)
    locator = AtlasLocator(search, heading_known="yaw_std_deg" in change)
    outcome, _ = locate_view(locator, dataclasses.replace(views[0], telemetry=telemetry))
    assert isinstance(outcome, NoFix) and outcome.reason != "internal_error"
    assert reasons is None or outcome.reason in reasons
    assert locator.state_name == "searching"


def test_blank_views_give_a_reason_and_no_fix(locator, views):
    black = dataclasses.replace(views[0], grey=np.zeros_like(views[0].grey))
    assert locator.locate(black).reason == "too_dark"
    noise = np.asarray(cv2.randu(np.zeros_like(views[0].grey), 0, 255))
    assert isinstance(locator.locate(dataclasses.replace(views[0], grey=noise)), NoFix)


def test_the_same_sheets_make_the_same_index(atlas, copied):
    shutil.rmtree(Path(copied.url, "index"))
    stages = []
    make_index(copied, lambda stage, share: stages.append((stage, share)))
    assert stages[0] == ("learn index", 0.0) and stages[-1] == ("index", 1.0)
    assert content(Path(copied.url, "index")) == content(Path(atlas.url, "index"))


def test_the_index_follows_the_sheets(copied, tmp_path, caplog):
    smallest = min(copied.sheets().values(), key=lambda each: each.tiles)
    kept = {key: copied.path(smallest, key) for key in smallest.files}
    aside = {key: shutil.copy(path, tmp_path / path.name) for key, path in kept.items()}
    before = read_manifest(copied)
    assert make_index(copied) == before
    copied.retire(smallest.id)
    assert stale_sheets(copied, before) == ([], [smallest.id])
    after = make_index(copied)
    assert smallest.id not in after.sheets
    assert set(copied.store.names("index")) == {*after.files, "index.json"}
    copied.put(aside, smallest)
    SheetSearch(copied)
    assert "1 sheets are missing from the index" in caplog.text
    assert make_index(copied) == before


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda plain: plain["shards"][0].update(name="../../../tmp/x"), "altered"),
        (lambda plain: plain["shards"][0].update(base=-5), "altered"),
        (lambda plain: plain["shards"][0]["parts"][0].update(rows=2.5), "altered"),
        (lambda plain: _asset(plain).update(name="../../../etc/passwd"), "altered"),
        (lambda plain: _asset(plain).update(size_bytes="x"), "size"),
        (lambda plain: plain.update(shards=7), "another kind"),
        (lambda plain: plain.update(shards=[]), "altered"),
    ],
)
def test_an_untrusted_index_is_checked(atlas, change, words):
    plain = json.loads(atlas.store.read(MANIFEST))
    assert IndexManifest.from_json(canonical(plain) + b"\n").to_json() == canonical(plain) + b"\n"
    change(plain)
    with pytest.raises(AtlasError, match=f"cannot be read.*{words}"):
        IndexManifest.from_json(canonical(plain) + b"\n")
    data = re.sub(rb'"rows":\d+', b'"rows":1e999', atlas.store.read(MANIFEST))
    with pytest.raises(AtlasError, match="cannot be read"):
        IndexManifest.from_json(data)


def _asset(plain):
    return plain["files"]["learnt.safetensors"]


def test_a_missing_and_a_damaged_index_are_reported(copied):
    copied.store.write(MANIFEST, b'{"format": "orthonav-index", "schema": 99}')
    with pytest.raises(AtlasError, match="cannot be read"):
        SheetSearch(copied)
    copied.store.remove(MANIFEST)
    with pytest.raises(AtlasError, match="orthonav atlas index"):
        SheetSearch(copied)
    assert make_index(copied) is not None


@pytest.mark.parametrize("name", ["mean", "basis", "rotation", "halves", "codebook"])
def test_damaged_parts_of_an_index_are_refused(atlas, tmp_path, name):
    recipe, path = read_manifest(atlas).recipe, tmp_path / LEARNT
    parts = load_file(Path(atlas.url, "index", LEARNT))
    save_file({**parts, name: parts[name][:-1]}, path)
    with pytest.raises(AtlasError, match="index of the atlas is damaged"):
        load_learnt(path, recipe)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(AtlasError, match="index of the atlas is damaged"):
        load_learnt(path, recipe)
