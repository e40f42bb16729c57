"""An atlas is built sheet by sheet: what is finished stays, what fails is named, bytes agree."""

import errno
import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from helpers import content
from orthonav.core.errors import (
    AreaError,
    AtlasError,
    StorageError,
    UsageError,
    VariantError,
    WorkerError,
)
from orthonav.core.mapfile import open_map
from orthonav.ground.atlas import build as building
from orthonav.ground.atlas.build import (
    AtlasRequest,
    Imagery,
    build_atlas,
    build_sheet,
    plan_sheets,
    versions,
)
from orthonav.ground.atlas.catalog import Atlas, AtlasRecipe, CoarseRecipe
from orthonav.ground.atlas.cluster import SerialRunner, attempted
from orthonav.ground.atlas.coarse import read_coarse
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.route import Route

COARSE = CoarseRecipe(gsd_m=4.0, tile_px=32, overlap=0.5)
SMALL = {"sheet_km": 0.3, "tile_px": 64, "overlap": 0.5, "calibration_views": 1}
SMALL["coarse"] = asdict(COARSE)
COUNT = 8
"""Sheets that the orthophoto lies on."""
RECIPE = AtlasRecipe(**{"gsd_m": 1.0, **SMALL, "coarse": COARSE})


@pytest.fixture(scope="module")
def built(ortho, tmp_path_factory):
    place = tmp_path_factory.mktemp("built") / "atlas"
    return place, made(place, ortho)


def made(place, *orthos, **request):
    request = {"recipe": SMALL, "index": False, **request}
    with SerialRunner() as runner:
        return build_atlas(AtlasRequest(str(place), orthos, **request), runner)


def test_an_atlas_holds_a_map_and_coarse_tiles_for_each_sheet(built, ortho):
    place, result = built
    sheets = Atlas.open(place).sheets()
    assert list(sheets) == sorted(result.built) and len(sheets) == COUNT and result.is_complete
    mosaic = Mosaic.open([ortho])
    atlas = Atlas.open(place)
    assert atlas.recipe == RECIPE, "the default resolution is that of the imagery"
    for name, sheet in sheets.items():
        opened = open_map(atlas.path(sheet))
        west, south, east, north = RECIPE.sheets.bounds_deg(name)
        assert sheet.bounds_deg == (west, south, east, north)
        assert sheet.tiles == opened.manifest.sheets[0].tiles > 0
        assert opened.manifest.recipe["overlap"] == 0.5
        coarse = read_coarse(atlas.path(sheet, "coarse"))
        assert len(coarse.valid) > 0
        assert sheet.dates == ("2019-06",) and sheet.made_by == versions()
        assert sheet.imagery == mosaic.describe()
    plain = result.to_plain()
    assert plain["tiles"] == sum(sheet.tiles for sheet in sheets.values())
    size_bytes = sum(sheet.size_bytes for sheet in sheets.values())
    assert plain["size_mb"] == pytest.approx(size_bytes / 1e6, abs=1e-4)
    assert plain["wall_s"] > 0


def test_an_atlas_does_not_depend_on_place_and_time_of_building(built, ortho, tmp_path):
    place, _ = built
    other_place = tmp_path / "other place" / ortho.name
    other_place.parent.mkdir()
    shutil.copy2(ortho, other_place)
    made(tmp_path / "again", other_place)
    assert content(tmp_path / "again") == content(place)
    assert not any(str(ortho.parent).encode() in data for data in content(place).values())


def test_present_sheets_are_unchanged_and_missing_ones_are_built(built, ortho, tmp_path):
    place = Path(shutil.copytree(built[0], tmp_path / "atlas"))
    again = made(place, ortho)
    assert not again.built and sorted(again.unchanged) == sorted(built[1].built)
    assert again.is_complete
    lost = sorted((place / "items").iterdir())[1]
    lost.unlink()
    again = made(place, ortho)
    assert list(again.built) == [lost.stem] and len(again.unchanged) == COUNT - 1
    assert content(place) == content(built[0])


def test_an_interrupt_keeps_finished_sheets(built, ortho, tmp_path):
    place = tmp_path / "atlas"

    def progress(stage, share):
        if share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), SerialRunner() as runner:
        build_atlas(AtlasRequest(str(place), [ortho], SMALL, index=False), runner, progress)
    assert len(Atlas.open(place).sheets()) == COUNT / 2
    assert len(made(place, ortho).built) == COUNT / 2
    assert content(place) == content(built[0])


def test_sheets_made_otherwise_are_refused_or_replaced(built, make_ortho, ortho, tmp_path):
    place = Path(shutil.copytree(built[0], tmp_path / "atlas"))
    changed = make_ortho(tmp_path / ortho.name, np.full((400, 400), 90, np.uint8))
    changed.write_bytes(ortho.read_bytes())
    os.utime(changed, (1e9, 1e9))
    before = content(place)
    why = r"8 of 8 sheets .*imagery has changed.*--replace"
    with pytest.raises(AtlasError, match=why) as caught:
        made(place, changed)
    assert sorted(built[1].built)[0] in str(caught.value) and content(place) == before
    result = made(place, changed, replace=True)
    assert len(result.built) == COUNT
    # The pictures are the same: so are the maps.
    after = content(place)
    assert {n for n in after.keys() ^ before.keys() if n.startswith("sheets")} == set()
    assert made(place, changed, replace=True).unchanged == sorted(result.built)


def test_another_relief_is_another_request(built, ortho):
    with pytest.raises(AtlasError, match="--replace"):
        made(built[0], ortho, relief="level")
    with pytest.raises(VariantError, match="--dem, --surface or --relief"):
        made(built[0], ortho, relief="level", dem=ortho)


def test_other_recipes_are_refused_with_the_differences(built, ortho):
    before = content(built[0])
    with pytest.raises(AtlasError, match=r"tile_px: 64, not 96"):
        made(built[0], ortho, recipe={"tile_px": 96})
    with pytest.raises(AtlasError, match=r"coarse: .*'overlap': 0.5.*, not .*0.75"):
        made(built[0], ortho, recipe={"coarse": {"overlap": 0.75}})
    own = made(built[0], ortho, recipe={})
    assert own.unchanged == sorted(built[1].built), "an atlas knows its own"
    assert content(built[0]) == before


@pytest.mark.parametrize(
    "recipe", [{"tile_px": 50}, {"tile_px": 2048}, {"overlap": 1.0}, {"coarse": {"tile_px": 33}}]
)
def test_impossible_recipes_leave_no_atlas(ortho, tmp_path, recipe):
    with pytest.raises((AreaError, AtlasError, UsageError)):
        made(tmp_path / "atlas", ortho, recipe={**SMALL, **recipe})
    assert not (tmp_path / "atlas").exists()
    with pytest.raises(AtlasError, match="impossible"):
        made(tmp_path / "atlas", ortho, recipe={**SMALL, "colour": 3})


def test_sheets_without_imagery_are_empty(make_ortho, tmp_path):
    grey = np.random.default_rng(0).integers(1, 255, (700, 300)).astype(np.uint8)
    grey[:500] = 0
    ortho = make_ortho(tmp_path / "half.tif", grey, nodata=0)
    result = made(tmp_path / "atlas", ortho)
    assert result.empty and result.built and result.is_complete
    assert set(Atlas.open(tmp_path / "atlas").sheets()) == set(result.built)


def test_other_versions_are_refused(ortho, tmp_path):
    task = plan_sheets(AtlasRequest(str(tmp_path), [ortho]), RECIPE, Mosaic.open([ortho]))[0]
    other = replace(task, sheet=replace(task.sheet, made_by={**versions(), "numpy": "1.0"}))
    with pytest.raises(WorkerError, match=rf"numpy {np.__version__}, not 1.0"):
        build_sheet(other)

    class Mixed(SerialRunner):
        def run(self, work, items, **_):
            yield items[0], attempted(work, other)

    request = AtlasRequest(str(tmp_path / "atlas"), [ortho], SMALL)
    with pytest.raises(WorkerError, match=rf"has other versions.*numpy {np.__version__}, not 1.0"):
        build_atlas(request, Mixed())


def test_a_worker_that_sees_other_imagery_refuses(ortho, tmp_path):
    copy = Path(shutil.copy2(ortho, tmp_path))
    task = plan_sheets(AtlasRequest(str(tmp_path), [copy]), RECIPE, Mosaic.open([copy]))[0]
    os.utime(copy, (5, 5))
    with pytest.raises(AtlasError, match="imagery has changed"):
        build_sheet(task)


@pytest.mark.long
def test_a_sheet_that_fails_is_named_and_the_others_are_built(
    ortho, tmp_path, monkeypatch, run, built
):
    full, broken = sorted(built[1].built)[:2]
    copied, make = shutil.copyfile, building.build_map

    def copy(source, to):
        if Path(source).name == f"{full}.onav":
            Path(to).write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return copied(source, to)

    def build(request, **more):
        if request.out.stem == broken:
            raise ZeroDivisionError("a bug")
        return make(request, **more)

    monkeypatch.setattr(shutil, "copyfile", copy)
    monkeypatch.setattr(building, "build_map", build)
    place = tmp_path / "atlas"
    Atlas.open_or_create(place, RECIPE)
    arguments = ["atlas", "build", place, "--ortho", ortho, "--json"]
    done = run(*arguments)
    assert done.code == 1
    assert f"error: sheet {full}: StorageError" in done.err and "full" in done.err
    assert f"error: sheet {broken}: ZeroDivisionError" in done.err
    summary = json.loads(done.out)
    assert [each["sheet"] for each in summary["failed"]] == [full, broken]
    assert summary["built"] == COUNT - 2
    there = [name for name in content(place) if full in name or broken in name]
    assert all(name.startswith("coarse/") for name in there), "whole, and named by no item"
    monkeypatch.undo()
    monkeypatch.setattr("orthonav.ground.atlas.index.make_index", lambda *_, **__: None)
    assert run(*arguments).code == 0
    assert content(place) == content(built[0])


def test_a_disk_that_stays_full_ends_the_build(ortho, tmp_path, monkeypatch):
    def full(task):
        raise StorageError("disk full")

    monkeypatch.setattr(building, "build_sheet", full)
    monkeypatch.setattr(building, "GIVE_UP_AFTER", 2)
    result = made(tmp_path / "atlas", ortho)
    assert len(result.failed) == 2 and result.untried == COUNT - 2 and not result.is_complete


def test_only_sheets_of_the_area_are_planned(ortho, built):
    mosaic = Mosaic.open([ortho])
    names = sorted(built[1].built)

    def planned(**area):
        found = plan_sheets(AtlasRequest("atlas", [ortho], **area), RECIPE, mosaic)
        return [task.sheet.id for task in found]

    west, south, east, north = RECIPE.sheets.bounds_deg(names[0])
    assert planned() == names
    assert planned(bounds_deg=(west, south, east, north)) == names[:1], "neighbours only touch"
    assert planned(bounds_deg=(-175.0, -80.0, 175.0, 80.0)) == names
    middle = (south + north) / 2
    route = Route(((middle, west + 1e-4), (middle, east - 1e-4)))
    assert planned(route=route, band_m=10.0) == names[:1]
    assert planned(route=route, band_m=1500.0) == names
    for area in ({"bounds_deg": (10.0, 10.0, 11.0, 11.0)}, {"band_m": 5.0}):
        with pytest.raises(ValueError, match=r"outside the orthophotos|band"):
            planned(**area)


def test_imagery_across_the_antimeridian_has_sheets_on_both_sides(ortho):
    source = Mosaic.open([ortho]).sources[0]
    lat = np.array([10.0, 10.0, 10.001, 10.001])
    lon = np.array([179.999, -179.999, -179.999, 179.999])
    moved = replace(source, outline_latlon_deg=np.stack([lat, lon], axis=1))
    imagery = Imagery(Mosaic((moved,), (None,)))
    found = sorted(imagery.sheets(RECIPE))
    edges = {RECIPE.sheets.bounds_deg(name)[0] for name in found}
    assert -180.0 in edges and max(edges) > 179.99
    for name in found:
        assert imagery.under(RECIPE.sheets.bounds_deg(name), 10.0).sources == (moved,)
    assert imagery.under((10.0, 10.0, 10.01, 10.01), 10.0).sources == ()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--sheet-km", "0.001"], "must be 0.2 to"),
        (["--cluster", "local", "--workers", "0"], "workers must be 1 or more"),
    ],
)
def test_conflicting_or_impossible_options_are_refused(
    run, ortho, tmp_path, monkeypatch, options, why
):
    monkeypatch.chdir(tmp_path)
    done = run("atlas", "build", "a", "--ortho", ortho, *options)
    assert done.code == 2 and why in done.err and not list(tmp_path.iterdir())


def test_an_interrupted_build_says_how_to_resume(run, ortho, tmp_path, monkeypatch):
    def interrupted(task):
        raise KeyboardInterrupt

    monkeypatch.setattr(building, "build_sheet", interrupted)
    done = run("atlas", "build", tmp_path / "atlas", "--ortho", ortho, "--tile-px", "64")
    assert done.code == 130 and "rerun to resume" in done.err
