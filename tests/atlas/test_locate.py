"""Views are located in an atlas of another year without a prior; negatives never are."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("faiss", reason="without it an atlas has no index: orthonav[atlas]")

from orthonav.core.errors import AtlasError
from orthonav.core.flight.folder import open_flight, read_truth
from orthonav.core.geo.frames import distances_m
from orthonav.core.records import Fix, NoFix, View
from orthonav.ground.atlas.catalog import Atlas, canonical
from orthonav.ground.atlas.index import (
    MANIFEST,
    IndexManifest,
    make_index,
    read_manifest,
    stale_sheets,
)
from orthonav.ground.atlas.locate import AtlasLocator
from orthonav.ground.atlas.search import SheetRegistrar, TileSearch
from orthonav.onboard.run import locate_view

CANDIDATES = 6
"""Registering candidates takes most of the time."""


@pytest.fixture(autouse=True)
def fewer_candidates(monkeypatch):
    monkeypatch.setattr("orthonav.ground.atlas.locate.CANDIDATES", CANDIDATES)


@pytest.fixture(scope="module")
def search(atlas):
    return TileSearch(atlas)


@pytest.fixture
def locator(atlas, search):
    return AtlasLocator(SheetRegistrar(atlas), search)


@pytest.fixture(scope="module")
def first_view(flown):
    flight = open_flight(flown)
    view = next(iter(flight.views))
    return View(view.grey(), flight.camera, view.telemetry)


@pytest.fixture
def copied(atlas, tmp_path):
    return Atlas.open(shutil.copytree(atlas.url, tmp_path / "copy"))


@pytest.mark.long
def test_a_flight_is_located_without_prior_and_heading(atlas, flown, tmp_path, run):
    out = tmp_path / "fixes.jsonl"
    done = run("localize", atlas.url, flown, "--out", out, "--heading", "unknown")
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    # One view alone never gives a fix.
    assert (lines[0]["status"], lines[0]["reason"], lines[0]["state"]) == (
        *("no_fix", "searching", "searching"),
    )
    truth = read_truth(flown / "truth.csv")
    fixes = [line for line in lines if line["status"] == "fix"]
    assert len(fixes) >= len(lines) - 3
    for fix in fixes:
        place = (fix["lat_deg"], fix["lon_deg"])
        assert distances_m([place], [truth[fix["frame"]]])[0] < 25
        assert fix["place_probability"] <= fix["evidence"]["recognized"]
    assert fixes[-1]["confidence"] > 0.9 and fixes[-1]["state"] == "tracking"


def test_options_of_maps_are_refused(atlas, flown, tmp_path, run):
    refused = run("localize", atlas.url, flown, "--out", tmp_path / "fixes.jsonl", "--track")
    assert refused.code == 2 and "--track" in refused.err


def test_a_negative_has_no_confident_fix(locator, first_view):
    mirrored = np.ascontiguousarray(first_view.grey[:, ::-1])
    outcome = locator.locate(dataclasses.replace(first_view, grey=mirrored))
    assert not (isinstance(outcome, Fix) and outcome.confidence > 0.8)


def test_views_of_another_scale_are_refused_with_the_reason(locator, first_view):
    low = dataclasses.replace(first_view.telemetry, agl_m=60.0)
    outcome = locator.locate(dataclasses.replace(first_view, telemetry=low))
    assert isinstance(outcome, NoFix)
    assert outcome.reason in {"wrong_scale", "too_small"}


def test_the_same_sheets_make_the_same_index(atlas, copied):
    shutil.rmtree(Path(copied.url, "index"))
    again = copied
    stages = []
    make_index(again, lambda stage, share: stages.append((stage, share)))
    assert stages[0] == ("learn index", 0.0) and stages[-1] == ("index", 1.0)
    names = sorted(atlas.store.names("index"))
    assert names == sorted(again.store.names("index"))
    for name in names:
        assert again.store.read(f"index/{name}") == atlas.store.read(f"index/{name}")


def test_the_index_follows_the_sheets(copied, tmp_path):
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
    assert TileSearch(copied).unknown == [smallest.id]
    assert make_index(copied) == before and not TileSearch(copied).unknown


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda plain: plain["shards"][0].update(name="../../../tmp/x"), "altered"),
        (lambda plain: plain["shards"][0].update(base=-5), "altered"),
        (lambda plain: plain["shards"][0]["parts"][0].update(rows=2.5), "altered"),
        (lambda plain: plain["shards"][0]["parts"][0].update(rows=True), "altered"),
        (lambda plain: plain["shards"][0]["parts"][0].update(sheet=1), "altered"),
        (lambda plain: plain["shards"][0]["parts"][0].update(retired=0), "altered"),
        (lambda plain: _asset(plain).update(name="../../../etc/passwd"), "altered"),
        (lambda plain: _asset(plain).update(size_bytes="x"), "size"),
        (lambda plain: _asset(plain).update(sha256="../../../etc/passwd"), "sha256"),
        (lambda plain: plain.update(shards=7), "another kind"),
        (lambda plain: plain.update(more=7), "altered"),
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
    return plain["files"]["quantizers.safetensors"]


def test_a_missing_and_a_damaged_index_are_reported(copied):
    damaged = copied
    damaged.store.write(MANIFEST, b'{"format": "orthonav-index", "schema": 99}')
    with pytest.raises(AtlasError, match="cannot be read"):
        TileSearch(damaged)
    damaged.store.remove(MANIFEST)
    with pytest.raises(AtlasError, match="orthonav atlas index"):
        TileSearch(damaged)
    assert make_index(damaged) is not None


def test_impossible_telemetry_gives_a_reason_and_no_fix(atlas, search, first_view):
    for change in (
        {"agl_m": np.nan},
        {"agl_m": -5.0},
        {"pitch_deg": 80.0},
        {"yaw_std_deg": -5.0, "yaw_deg": 10.0},
        {"tilt_std_deg": np.nan},
    ):
        telemetry = dataclasses.replace(first_view.telemetry, **change)
        registrar = SheetRegistrar(atlas)
        locator = AtlasLocator(registrar, search, heading_known="yaw_std_deg" in change)
        outcome, _ = locate_view(locator, dataclasses.replace(first_view, telemetry=telemetry))
        assert isinstance(outcome, NoFix)
        assert outcome.reason != "internal_error"
        assert locator.state_name == "searching"


def test_blank_views_give_a_reason_and_no_fix(locator, first_view):
    black = dataclasses.replace(first_view, grey=np.zeros_like(first_view.grey))
    assert locator.locate(black).reason == "too_dark"
    noise = np.asarray(cv2.randu(np.zeros_like(first_view.grey), 0, 255))
    assert isinstance(locator.locate(dataclasses.replace(first_view, grey=noise)), NoFix)
