"""What is wrong with an atlas is found, what is left over goes, and nothing else does."""

import hashlib
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from atlases import EAST, HERE, PLACES, RECIPE, described

from orthonav.ground.atlas.catalog import Atlas, StoredFile, canonical
from orthonav.ground.atlas.index import IndexManifest
from orthonav.ground.atlas.integrity import check_atlas
from orthonav.ground.atlas.store import Store
from orthonav.ground.atlas.vectors import Part, ShardInfo, VectorRecipe


def two_sheets(url, tmp_path):
    atlas = Atlas.open_or_create(url, RECIPE)
    for sheet in (HERE, EAST):
        (tmp_path / "file").write_text(f"map of {sheet}")
        atlas.put({"map": tmp_path / "file"}, described(sheet))
    return atlas


@pytest.fixture
def atlas(url, tmp_path):
    return two_sheets(url, tmp_path)


@pytest.fixture
def near(tmp_path):
    return two_sheets(tmp_path / "atlas", tmp_path)


def found(atlas, **how):
    return [(problem.kind, problem.name) for problem in check_atlas(atlas, **how)]


def test_a_whole_atlas_has_no_problems(atlas):
    assert check_atlas(atlas) == [] == check_atlas(atlas, clean=True, min_age_s=0)
    atlas.snapshot()
    assert check_atlas(atlas) == []


def test_missing_and_incomplete_files_are_found(atlas, tmp_path):
    here, east = (atlas.sheets()[name].files["map"].name for name in (HERE, EAST))
    atlas.store.remove(here)
    atlas.store.write(east, b"map")
    wrong = [("missing file", here), ("wrong size", east)]
    assert found(atlas) == wrong == found(atlas, clean=True, min_age_s=0)
    (tmp_path / "file").write_text(f"map of {HERE}")
    atlas.put({"map": tmp_path / "file"}, described(HERE))  # building it again heals it
    assert found(atlas) == wrong[1:]


def test_altered_content_is_found_by_a_deep_check(atlas):
    name = atlas.sheets()[HERE].files["map"].name
    atlas.store.write(name, b"m" * atlas.store.size(name))
    assert found(atlas) == []
    assert ("wrong checksum", name) in found(atlas, deep=True)


def test_old_leftovers_are_removed(atlas):
    orphan = f"sheets/{HERE}.0123456789ab.onav"
    half = f"sheets/.{HERE}.0123456789ab.onav.a1b2c3d4.tmp.onav"
    names = {orphan: "orphan", half: "leftover", ".atlas.json.a1b2c3d4e5f6.tmp": "leftover"}
    names[f"coarse/{EAST}.0123456789ab.safetensors"] = "orphan"
    for name in [*names, "notes.txt", "sheets/notes.onav", "items/.DS_Store"]:
        atlas.store.write(name, b"x")
    expected = sorted((kind, name) for name, kind in names.items())
    assert sorted(found(atlas)) == expected
    young = check_atlas(atlas, clean=True)
    assert [each.detail.rpartition("; ")[2] for each in young] == ["too young to be removed"] * 4
    assert sorted(found(atlas)) == expected
    gone = check_atlas(atlas, clean=True, min_age_s=-5)
    assert len(gone) == 4 and all(each.removed for each in gone)
    assert found(atlas) == [] and atlas.store.read("sheets/notes.onav") == b"x"
    assert len(atlas.sheets(refresh=True)) == 2


def test_files_of_unreadable_items_stay(near):
    path = Path(near.url, near.sheets()[HERE].item_name)
    path.write_bytes(path.read_bytes()[:-2])
    assert found(near, clean=True, min_age_s=-5) == [("damaged item", f"items/{path.name}")]
    assert len(near.store.names("sheets")) == 2
    near.retire(HERE)
    assert [kind for kind, _ in found(near, clean=True, min_age_s=-5)] == ["orphan"]
    assert found(near) == [] and list(near.sheets(refresh=True)) == [EAST]


def test_a_sheet_of_another_lattice_is_found(near):
    description = replace(near.sheets()[HERE], bounds_deg=RECIPE.sheets.bounds_deg(EAST))
    near.store.write(description.item_name, canonical(description.to_item()))
    assert [kind for kind, _ in found(near)] == ["damaged item"]


def test_a_stale_or_damaged_index_is_found(atlas):
    asset = StoredFile("index/a.npy", 3, hashlib.sha256(b"abc").hexdigest())
    shard = ShardInfo("a", 0, (Part(HERE, "ab" * 32, 5),))
    manifest = IndexManifest(VectorRecipe(dims=64), (shard,), {"a.npy": asset})
    atlas.store.write("index/index.json", manifest.to_json())
    atlas.store.write("index/.a.npy.a1b2c3d4.tmp.npy", b"a")
    stale = [("stale index", "index/index.json")]  # no sheet has coarse tiles (any more)
    half = [("leftover", "index/.a.npy.a1b2c3d4.tmp.npy")]
    assert found(atlas, clean=True, min_age_s=-5) == [*half, ("missing file", asset.name), *stale]
    atlas.store.write(asset.name, b"ab")
    assert found(atlas) == [("wrong size", asset.name), *stale]
    atlas.store.write(asset.name, b"abd")
    assert found(atlas) == stale
    assert ("wrong checksum", asset.name) in found(atlas, deep=True)
    outside = replace(manifest, files={"a.npy": replace(asset, name="../../etc/passwd")})
    atlas.store.write("index/index.json", outside.to_json())
    assert found(atlas) == [("damaged file", "index/index.json")]
    atlas.store.write("index/index.json", b"{}")
    assert found(atlas) == [("damaged file", "index/index.json")]


def test_a_sheet_finished_meanwhile_is_no_orphan(near, tmp_path, monkeypatch):
    act = Store.names

    def names(self, folder=""):
        found = act(self, folder)
        if folder == "sheets" and EAST not in near.sheets():
            (tmp_path / "file").write_text(f"map of {EAST}")
            near.put({"map": tmp_path / "file"}, described(EAST))
        return found

    near.retire(EAST)
    monkeypatch.setattr(Store, "names", names)
    assert found(near, clean=True, min_age_s=-5) == []


def test_a_full_disk_is_reported(near, monkeypatch, run):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orthonav.ground.atlas.store.shutil.copyfile", full)
    assert run("atlas", "add", near.url + "2", near.url).code == 1


def test_info(near, run):
    done = run("atlas", "info", near.url)
    assert done.code == 0 and "sheets           2" in done.out
    for words in ("6.5", "gsd_m 1.0", "2020-06-14", "BD ORTHO, IGN, Etalab-2.0"):
        assert words in done.out
    done = run("atlas", "info", near.url, "--json")
    plain = json.loads(done.out)
    assert plain["sheets"] == 2 and plain["names"] == [HERE, EAST] and plain["area_km2"] == 6.5
    assert plain["bytes"] == 2 * len("map of r000000c000000")
    assert plain["recipe"] == RECIPE.to_plain() and plain["made_by"] == ["orthonav 1.0"]
    west, south, east, north = plain["bounds_deg"]
    assert all(west < lon < east and south < lat < north for lat, lon in PLACES)


def test_info_of_an_empty_folder_and_an_empty_atlas(tmp_path, run):
    done = run("atlas", "info", tmp_path)
    assert done.code == 1 and done.err.startswith("orthonav: error: no atlas")
    Atlas.open_or_create(tmp_path / "atlas", RECIPE)
    done = run("atlas", "info", tmp_path / "atlas")
    assert (
        done.code == 0
        and "date             unknown" in done.out
        and "sheets           0" in done.out
    )


def test_check(near, run):
    done = run("atlas", "check", near.url)
    assert (done.code, done.out) == (0, f"whole, by names and sizes: {near.url}\n")
    near.store.remove(near.sheets()[HERE].files["map"].name)
    near.store.write(".atlas.json.a1b2c3d4.tmp.json", b"")
    os.utime(Path(near.url, ".atlas.json.a1b2c3d4.tmp.json"), (0, 0))
    done = run("atlas", "check", near.url, "--clean")
    assert done.code == 3 and "missing file    sheets/" in done.out and "1 problems" in done.out
    assert "(fixed)" in done.out
    done = run("atlas", "check", near.url, "--json", "--deep")
    plain = json.loads(done.out)
    assert done.code == 3 and not plain["whole"] and plain["deep"]
    assert {each["kind"] for each in plain["problems"]} == {"missing file"}


def test_add_and_retire(near, tmp_path, run):
    copy = tmp_path / "copy"
    done = run("atlas", "add", copy, near.url)
    assert (done.code, done.out) == (0, f"2 sheets added, 0 unchanged: {copy}\n")
    done = run("atlas", "add", copy, near.url, "--replace")
    assert done.out.startswith("0 sheets added, 2 unchanged")
    assert list(Atlas.open(copy).sheets()) == [HERE, EAST] and found(Atlas.open(copy)) == []
    done = run("atlas", "retire", copy, HERE, EAST)
    assert done.code == 0 and Atlas.open(copy).sheets() == {} and found(Atlas.open(copy)) == []
    done = run("atlas", "retire", copy, HERE)
    assert done.code == 1 and "has no sheet" in done.err
    shutil.rmtree(copy)
    Atlas.open_or_create(copy, replace(RECIPE, overlap=0.5))
    done = run("atlas", "add", copy, near.url)
    assert done.code == 1 and "overlap: 0.5, not 0.875" in done.err


def test_sheets_are_listed_even_if_no_index_can_be_made(near, tmp_path, run):
    files = {"map": tmp_path / "map", "coarse": tmp_path / "coarse"}
    for path in files.values():
        path.write_text("no tiles")
    near.put(files, described(HERE))
    done = run("atlas", "index", near.url)
    assert done.code == 1 and "coarse" in done.err
    assert len(json.loads(near.store.read("items.geojson"))["features"]) == 2
