"""The catalogue of an atlas: canonical, checked, and whole whenever somebody is killed."""

import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from atlases import EAST, HERE, RECIPE, described

from helpers import content
from orthonav.core.errors import AreaError, AtlasError, StorageError
from orthonav.ground.atlas.catalog import (
    Atlas,
    AtlasRecipe,
    CoarseRecipe,
    StoredFile,
    canonical,
    copy_sheets,
    read_item,
)
from orthonav.ground.atlas.integrity import check_atlas
from orthonav.ground.atlas.store import Store


@pytest.fixture
def files(tmp_path):
    def make(content="one"):
        made = {key: tmp_path / f"{key} {content}" for key in ("map", "coarse")}
        for key, path in made.items():
            path.write_text(f"{key} of {content}")
        return made

    return make


@pytest.fixture
def atlas(url):
    return Atlas.open_or_create(url, RECIPE)


@pytest.fixture
def near(tmp_path):
    return Atlas.open_or_create(tmp_path / "atlas", RECIPE)


def test_a_sheet_that_is_put_is_read_back(atlas, files):
    sheet = atlas.put(files(), described())
    again = Atlas.open(atlas.url)
    assert again.recipe == RECIPE and again.sheets() == {HERE: sheet} == atlas.sheets()
    assert sheet.made_by == {"orthonav": "1.0"}
    assert sheet.size_bytes == len("map of one") + len("coarse of one")
    assert again.path(sheet).read_text() == "map of one"
    assert again.path(sheet, "coarse").read_text() == "coarse of one"
    assert again.path(sheet).suffix == ".onav"
    assert check_atlas(again) == []


def test_putting_the_same_sheet_again_writes_nothing(atlas, files, monkeypatch):
    atlas.put(files(), described())
    for name in ("write", "remove"):
        monkeypatch.setattr(Store, name, lambda *_: pytest.fail("nothing to do"))
    assert atlas.put(files(), described()) == atlas.sheets()[HERE]


@pytest.mark.parametrize(("content", "request_"), [("two", "request 1"), ("one", "request 2")])
def test_a_sheet_is_replaced(atlas, files, content, request_):
    atlas.put(files(), described())
    atlas.put(files("east"), described(EAST))
    sheet = atlas.put(files(content), described(request=request_))
    again = Atlas.open(atlas.url)
    assert list(again.sheets()) == [HERE, EAST] and again.sheets()[HERE] == sheet
    assert again.path(sheet).read_text() == f"map of {content}"
    assert [len(atlas.store.names(name)) for name in ("items", "sheets", "coarse")] == [2, 2, 2]
    assert check_atlas(again) == []


def test_a_sheet_is_retired(atlas, files):
    atlas.put(files(), described())
    atlas.put(files(), described(EAST))
    atlas.retire(HERE)
    assert list(atlas.sheets()) == [EAST] == list(atlas.sheets(refresh=True))
    assert check_atlas(atlas) == []
    with pytest.raises(AtlasError, match=f"has no sheet '{HERE}'"):
        atlas.retire(HERE)


def test_the_same_atlas_byte_for_byte(tmp_path, files):
    def make(url, order):
        atlas = Atlas.open_or_create(url, RECIPE)
        for sheet in order:
            atlas.put(files(sheet), described(sheet))
        atlas.snapshot()
        return content(url)

    assert make(tmp_path / "a", [HERE, EAST]) == make(tmp_path / "b", [EAST, HERE])


def test_sheets_that_do_not_fit_are_refused(near, files):
    with pytest.raises(AtlasError, match="the lattice of the atlas has"):
        near.put(files(), described(bounds_deg=(1.0, 46.0, 1.1, 46.1)))
    with pytest.raises(AreaError, match="no sheet of 10 km is named 'r999999c000000'"):
        near.put(files(), described(id="r999999c000000"))
    with pytest.raises(AtlasError, match="names no map"):
        near.put({"coarse": files()["coarse"]}, described())
    with pytest.raises(AtlasError, match="cannot be written into the catalogue"):
        near.put(files(), described(area_km2=float("nan")))
    with pytest.raises(AtlasError, match="not an item of orthonav"):
        near.put(files(), described(tiles=0))
    assert near.sheets() == {} and list(content(near.url)) == ["atlas.json"]


def test_creating_and_opening(tmp_path):
    with pytest.raises(AtlasError, match=r"no atlas: it has no atlas\.json"):
        Atlas.open(tmp_path / "none")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "inner").mkdir()
    with pytest.raises(AtlasError, match="holds other files"):
        Atlas.open_or_create(tmp_path / "photos", RECIPE)
    url = tmp_path / "atlas"
    assert Atlas.open_or_create(url, RECIPE).recipe == RECIPE
    assert Atlas.open_or_create(url, RECIPE).recipe == RECIPE
    with pytest.raises(AtlasError, match=r"alike.*gsd_m: 1\.0, not 0\.5.*tile_px: 256, not 64"):
        Atlas.open_or_create(url, replace(RECIPE, gsd_m=0.5, tile_px=64))
    with pytest.raises(AtlasError, match="coarse"):
        Atlas.open_or_create(url, replace(RECIPE, coarse=CoarseRecipe(gsd_m=4.0)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text[:-5], "damaged"),
        (lambda text: text.replace("orthonav-atlas", "other"), "not an atlas of orthonav"),
        (lambda text: text.replace('"schema":2', '"schema":3'), "update orthonav"),
        (lambda text: text.replace('"schema":2', '"schema":"2"'), "impossible recipe or schema"),
        (lambda text: text.replace('"gsd_m":1.0', '"gsd_m":NaN'), "recipe of the atlas"),
        (lambda text: text.replace('"overlap":0.875,', ""), "recipe of the atlas cannot be read"),
        (lambda text: text.replace("Licences", "No licences"), "altered"),
        (lambda text: "[" * 100_000, "damaged"),
        (lambda text: "[]", "not an atlas of orthonav"),
    ],
)
def test_an_altered_catalogue_is_refused(near, change, words):
    path = Path(near.url) / "atlas.json"
    path.write_text(change(path.read_text()))
    with pytest.raises(AtlasError, match=words):
        Atlas.open(near.url)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("gsd_m", "abc"), ("gsd_m", 0.0), ("tile_px", -3), ("tile_px", True), ("overlap", 1.0)),
        *(("sheet_km", 1e6), ("coarse", {"width": 3}), ("coarse", 5)),
        ("coarse", {"gsd_m": -8.0, "tile_px": 128, "overlap": 0.5}),
    ],
    ids=str,
)
def test_impossible_recipes_are_refused(name, value):
    with pytest.raises(AtlasError, match="recipe"):
        AtlasRecipe.from_plain({**RECIPE.to_plain(), name: value})


def test_an_atlas_without_coarse_tiles_is_to_be_built_again(near):
    path = Path(near.url) / "atlas.json"
    plain = json.loads(path.read_text())
    plain["orthonav:atlas"]["recipe"]["coarse"] = None
    path.write_bytes(canonical(plain))
    with pytest.raises(AtlasError, match=r"^the atlas has no coarse tiles.*build it again"):
        Atlas.open(near.url)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("id",), "../x"),
        (("bbox",), [2.0, 46.0, 1.0, 47.0]),
        (("bbox",), ["a", 46.0, 1.0, 47.0]),
        (("properties", "gsd"), 0.0),
        (("properties", "orthonav:sheet"), None),
        (("properties", "orthonav:sheet", "tiles"), 1.5),
        (("assets", "map", "href"), "../../../etc/passwd"),
        (("assets", "map", "file:size"), -1),
        (("assets", "map", "file:checksum"), "1220" + "g" * 64),
        (("assets", "model"), {}),
        (("assets", "map"), None),
    ],
)
def test_untrusted_items_are_refused(near, files, path, value):
    item = near.put(files(), described()).to_item()
    *parents, last = path
    functools.reduce(lambda inner, key: inner[key], parents, item)[last] = value
    near.store.write(f"items/{HERE}.json", canonical(item))
    with pytest.raises(AtlasError, match=f"items/{HERE}"):
        near.sheets(refresh=True)
    with pytest.raises(AtlasError, match=r"atlas check.*atlas retire"):
        Atlas.open(near.url).sheets()


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-1],
        lambda data: data.replace(b'"tiles":12', b'"tiles":11,"tiles":12'),
        lambda data: data.replace(b"3.25", b"Infinity"),
        lambda data: b"[" * 100_000,
        lambda data: b"\xff",
        lambda data: b" " * (2**20 + 1),
    ],
)
def test_damaged_items_are_reported_and_can_be_replaced(near, files, change):
    sheet = near.put(files(), described())
    path = Path(near.url, sheet.item_name)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(AtlasError, match=f"items/{HERE}"):
        near.sheets(refresh=True)
    assert [each.kind for each in check_atlas(near)] == ["damaged item"]
    assert near.put(files("two"), described()) == near.sheets(refresh=True)[HERE]
    near.retire(HERE)
    assert near.sheets(refresh=True) == {}


class Killed(BaseException):
    """As if the process ended here."""


def killed_at(monkeypatch, step, error):
    """Everything that changes the store fails from its `step`-th half-step on: before, after."""
    count = iter(range(10**6))

    def failing(act):
        def acted(*arguments):
            if next(count) >= step:
                raise error
            act(*arguments)
            if next(count) >= step:
                raise error

        return acted

    for name in ("write", "remove"):
        monkeypatch.setattr(Store, name, failing(getattr(Store, name)))


@pytest.mark.parametrize("error", [Killed(), StorageError("disk full")], ids=["kill", "full"])
@pytest.mark.parametrize("act", ["put", "replace", "retire"])
def test_a_kill_at_any_step_leaves_the_old_or_the_new_sheet(near, files, monkeypatch, act, error):
    near.put(files("east"), described(EAST))
    before = [] if act == "put" else [near.put(files(), described())]
    saved = Path(near.url).with_name("saved")
    shutil.copytree(near.url, saved)

    def change(atlas):
        if act == "retire":
            atlas.retire(HERE)
        else:
            atlas.put(files("two"), described(request="request 2"))

    for step in range(100):
        shutil.rmtree(near.url)
        shutil.copytree(saved, near.url)
        with monkeypatch.context() as patch:
            killed_at(patch, step, error)
            try:
                change(Atlas.open(near.url))
                break
            except type(error):
                pass
        again = Atlas.open(near.url)
        found = again.sheets().get(HERE)
        assert again.path(again.sheets()[EAST]).read_text() == "map of east"
        if found is not None:
            content = "one" if found in before else "two"
            assert again.path(found).read_text() == f"map of {content}"
            assert again.path(found, "coarse").read_text() == f"coarse of {content}"
        else:
            assert act != "replace"
        assert {problem.kind for problem in check_atlas(again)} <= {"orphan"}
        assert all(each.removed for each in check_atlas(again, clean=True, min_age_s=0))
        assert check_atlas(again) == [] and again.sheets(refresh=True).get(HERE) == found
        if found is not None or act != "retire":
            change(again)
        assert (HERE in again.sheets(refresh=True)) == (act != "retire")
    assert step == {"put": 6, "replace": 10, "retire": 6}[act]
    assert check_atlas(near) == []


def test_the_snapshot_shows_all_sheets(atlas, files):
    for sheet in (HERE, EAST):
        atlas.put(files(sheet), described(sheet))
    atlas.snapshot()
    features = json.loads(atlas.store.read("items.geojson"))["features"]
    assert [each["id"] for each in features] == [HERE, EAST]
    assert features[0]["assets"]["map"]["href"] == f"./{atlas.sheets()[HERE].files['map'].name}"


def test_items_are_stac(near, files):
    from pystac import Collection, Item, STACObjectType
    from pystac.errors import STACValidationError
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    sheet = near.put(files(), described())
    item = Item.from_file(str(Path(near.url, sheet.item_name)))
    collection = Collection.from_file(str(Path(near.url, "atlas.json")))
    validator = JsonSchemaSTACValidator()  # it brings the schemas of 1.1, which asks for no less
    for plain, kind in (
        (sheet.to_item(), STACObjectType.ITEM),
        (described(dates=("2020",), files=sheet.files).to_item(), STACObjectType.ITEM),
        (json.loads(near.store.read("atlas.json")), STACObjectType.COLLECTION),
    ):
        assert validator.validate_core({**plain, "stac_version": "1.1.0"}, kind, "1.1.0")
        with pytest.raises(STACValidationError):
            validator.validate_core({**plain, "links": 1, "stac_version": "1.1.0"}, kind, "1.1.0")
    assert item.id == HERE and item.datetime.isoformat() == "2020-06-14T00:00:00+00:00"
    assert Path(item.assets["map"].get_absolute_href()) == near.path(sheet)
    assert item.get_parent().id == collection.id == item.collection_id
    assert item.assets["map"].extra_fields["file:size"] == sheet.files["map"].size_bytes
    multihash = bytes.fromhex(item.assets["map"].extra_fields["file:checksum"])
    assert multihash[:2] == b"\x12\x20" and multihash[2:].hex() == sheet.files["map"].sha256


@pytest.mark.parametrize(
    ("dates", "times"),
    [
        ((), {"datetime": "1970-01-01T00:00:00Z", "orthonav:date_known": False}),
        (("soon", "2020-13"), {"datetime": "1970-01-01T00:00:00Z", "orthonav:date_known": False}),
        (("2020-06-14", "2020-06-14"), {"datetime": "2020-06-14T00:00:00Z"}),
        (("2020",), ("2020-01-01T00:00:00Z", "2020-12-31T23:59:59Z")),
        (("2024-02",), ("2024-02-01T00:00:00Z", "2024-02-29T23:59:59Z")),
        (("2021-12", "2019-03-04"), ("2019-03-04T00:00:00Z", "2021-12-31T23:59:59Z")),
        (("9999",), ("9999-01-01T00:00:00Z", "9999-12-31T23:59:59Z")),
    ],
)
def test_dates_become_times_of_stac(dates, times):
    asset = StoredFile(f"sheets/{HERE}.{'0' * 12}.onav", 1, "0" * 64)
    sheet = described(dates=dates, files={"map": asset})
    found = {k: v for k, v in sheet.to_item()["properties"].items() if "date" in k}
    if isinstance(times, tuple):
        times = {"datetime": None, "start_datetime": times[0], "end_datetime": times[1]}
    assert found == times
    assert read_item(sheet.item_name, canonical(sheet.to_item())) == sheet


def test_sheets_are_copied_from_another_atlas(tmp_path, files, near):
    source = Atlas.open_or_create(tmp_path / "source", RECIPE)
    for sheet in (HERE, EAST):
        source.put(files(sheet), described(sheet))
    near.put(files(EAST), described(EAST))
    assert copy_sheets(source, near) == ([HERE], [EAST])
    assert content(near.url) == {**content(source.url), **content(near.url)}
    source.put(files("new"), described())
    assert copy_sheets(source, near) == ([], [HERE, EAST])
    assert copy_sheets(source, near, replace=True) == ([HERE], [EAST])
    assert near.path(near.sheets()[HERE]).read_text() == "map of new"
    assert check_atlas(near) == []
    other = Atlas.open_or_create(tmp_path / "other", replace(RECIPE, overlap=0.5))
    with pytest.raises(AtlasError, match=r"overlap: 0\.5, not 0\.875"):
        copy_sheets(source, other)


def test_a_damaged_sheet_is_not_copied(tmp_path, files, near):
    source = Atlas.open_or_create(tmp_path / "source", RECIPE)
    sheet = source.put(files(), described())
    source.path(sheet).write_text("map of two")  # of the same size
    with pytest.raises(StorageError):
        copy_sheets(Atlas.open(source.url), near)
    assert near.sheets(refresh=True) == {} and near.store.names("sheets") == {}
