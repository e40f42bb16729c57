"""Ground that changed is found by views of it, and light, exposure and a single view are not it."""

import json

import numpy as np
import pytest
import rasterio

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.changes.ground import SeenCells, changed_ground
from orthonav.ground.changes.record import ChangedGround, ChangeGrid, read_changes, write_changes
from orthonav.ground.simulate.flight import SimulateRequest, simulate_flight

FRAME = LocalFrame(48.0, 2.0)
GRID = ChangeGrid(-200.0, 150.0, 10.0, 30, 40, FRAME)
RIGHT = np.s_[:, 30:]
"""Columns that changed in the views below."""


def seen_by(count, *, gain=1.0, offset=0.0, structure=0.5, changed=True, noise=2.0, cells=None):
    """Views of all cells, whose ground on the right changed in both kinds of evidence."""
    rng = np.random.default_rng(3)
    tone = rng.uniform(60, 180, (GRID.rows, GRID.cols))
    numbers = np.arange(GRID.rows * GRID.cols) if cells is None else cells
    views = []
    for _ in range(count):
        agreed = np.full(tone.shape, structure) + rng.normal(0, 0.05, tone.shape)
        now = gain * tone + offset + rng.normal(0, noise, tone.shape)
        if changed:
            agreed[RIGHT] -= structure
            now[RIGHT] = gain * np.roll(tone, 7, axis=0)[RIGHT] + offset + 40
        both = (each.ravel()[numbers] for each in (agreed, now, tone))
        views.append(SeenCells(numbers, *both))
    return views


def test_ground_that_changed_is_named():
    found = changed_ground(seen_by(5), GRID)
    assert found.changed[RIGHT].mean() > 0.7
    assert found.changed[:, :30].mean() < 0.01
    assert found.views.min() == 5
    assert found.score[RIGHT].mean() > 0.7 > 0.2 > found.score[:, :30].mean()


@pytest.mark.parametrize(
    ("gain", "offset", "structure"), [(0.5, 10.0, 0.5), (1.6, -30.0, 0.4), (1.0, 60.0, 0.25)]
)
def test_light_exposure_and_blur_are_no_change(gain, offset, structure):
    views = seen_by(4, gain=gain, offset=offset, structure=structure, changed=False)
    assert changed_ground(views, GRID).changed.mean() < 0.01


def test_of_two_views_both_must_disagree():
    views = [*seen_by(1), *seen_by(1, changed=False)]
    assert not changed_ground(views, GRID).changed.any()


def test_one_view_needs_both_kinds_of_evidence():
    (view,) = seen_by(1)
    assert changed_ground([view], GRID).changed[RIGHT].mean() > 0.4
    agreeing = SeenCells(view.cells, np.full(len(view.cells), 0.4), view.view_tone, view.map_tone)
    assert not changed_ground([agreeing], GRID).changed.any()


@pytest.fixture
def some():
    found = changed_ground(seen_by(3), GRID, map_name="ü.onav", map_sha256="ab")
    return found


def test_a_report_is_read_as_written(some, tmp_path):
    path = tmp_path / "changes.geojson"
    write_changes(path, some)
    again = read_changes(path)
    assert again.grid == some.grid and again.map_name == "ü.onav" and again.map_sha256 == "ab"
    np.testing.assert_allclose(again.score, some.score, atol=6e-4)
    np.testing.assert_array_equal(again.views, some.views)
    np.testing.assert_array_equal(again.changed, some.changed)
    plain = json.loads(path.read_text())
    assert len(plain["features"]) == GRID.rows * GRID.cols
    ring = np.array(plain["features"][0]["geometry"]["coordinates"][0])
    assert (ring[0] == ring[-1]).all()
    middle = FRAME.en_from_latlon(ring[:4, 1].mean(), ring[:4, 0].mean())
    assert middle == pytest.approx([-195.0, 145.0], abs=0.05)


def test_changed_ground_is_found_from_another_plane(some):
    other = LocalFrame(48.01, 2.01)
    rows, cols = np.nonzero(some.changed)
    points = np.stack([-200 + 10 * (cols + 0.5), 150 - 10 * (rows + 0.5)], axis=-1)
    assert some.covers(points, FRAME).all()
    moved = other.en_from_latlon(*FRAME.latlon_from_en(points))
    assert some.covers(moved, other).all()
    assert not some.covers(points + 10_000.0, FRAME).any()


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", '{"format": "orthonav-changes"}'),
        '{"format": "orthonav-changes", "version": 9}',
        '{"type": "FeatureCollection", "features": []}',
    ],
)
def test_other_files_are_refused(text, tmp_path):
    path = tmp_path / "other.geojson"
    path.write_text(text)
    with pytest.raises(FlightError, match="not a report of changed ground"):
        read_changes(path)


def test_crafted_reports_are_refused(some, tmp_path):
    path = tmp_path / "changes.geojson"
    write_changes(path, some)
    plain = json.loads(path.read_text())
    for name, value in (("rows", 10**9), ("side_m", 0), ("side_m", float("nan")), ("cols", -3)):
        path.write_text(json.dumps(plain | {"cells": plain["cells"] | {name: value}}))
        with pytest.raises(FlightError, match="not a report"):
            read_changes(path)
    plain["features"][0]["properties"]["row"] = -1
    path.write_text(json.dumps(plain))
    with pytest.raises(FlightError, match="outside the grid"):
        read_changes(path)
    with pytest.raises(MissingFileError):
        read_changes(tmp_path / "none.geojson")


# The commands.


@pytest.fixture(scope="module")
def built_over(area, tmp_path_factory):
    """A flight over the map's own date in other light, with a new square of 250 m, and its box."""
    folder = tmp_path_factory.mktemp("changed")
    with rasterio.open(area.past) as data:
        rgb, profile, transform = data.read(), data.profile, data.transform
    lit = np.clip(0.8 * rgb.astype(np.float32) + 25, 0, 255).astype(np.uint8)
    rows, cols = slice(350, 600), slice(480, 730)
    hall = np.random.default_rng(4).normal(225, 8, lit[:, rows, cols].shape)
    lit[:, rows, cols] = np.clip(hall, 0, 255).astype(np.uint8)
    with rasterio.open(folder / "later.tif", "w", **profile) as data:
        data.write(lit)
    request = SimulateRequest(
        [folder / "later.tif"], folder / "flight", random=16, agl_m=area.agl_m, camera=area.camera
    )
    simulate_flight(request)
    corners = [transform * (cols.start, rows.stop), transform * (cols.stop, rows.start)]
    return folder, profile["crs"], corners


def shares(found: ChangedGround, crs, corners):
    """Share of the seen cells named changed, inside a box and outside of it."""
    from rasterio.warp import transform as warped

    grid = found.grid
    rows, cols = np.mgrid[: grid.rows, : grid.cols] + 0.5
    points = np.stack([grid.west_m + cols * grid.side_m, grid.north_m - rows * grid.side_m], -1)
    lat, lon = grid.frame.latlon_from_en(points.reshape(-1, 2))
    x, y = (np.array(each).reshape(rows.shape) for each in warped("EPSG:4326", crs, lon, lat))
    (west, south), (east, north) = corners
    inside = (x > west + 25) & (x < east - 25) & (y > south + 25) & (y < north - 25)
    beyond = (x < west - 25) | (x > east + 25) | (y < south - 25) | (y > north + 25)
    seen = found.views > 0
    return found.changed[seen & inside].mean(), found.changed[seen & beyond].mean()


@pytest.mark.long
def test_localize_reports_what_was_built(run, built_over, map_path, tmp_path):
    folder, crs, corners = built_over
    fixes, out = tmp_path / "fixes.jsonl", tmp_path / "a.geojson"
    done = run(
        "localize", map_path, folder / "flight", "--out", fixes, "--report-changes", out, "--json"
    )
    assert done.code == 0
    assert json.loads(done.out)["changes"]["changed_m2"] > 10_000
    found = read_changes(out)
    built, elsewhere = shares(found, crs, corners)
    assert built > 0.6 and elsewhere < 0.03


@pytest.mark.long
def test_changes_need_a_map_that_shows_the_ground(run, built_over, map_path, tmp_path):
    folder, _, _ = built_over
    out = tmp_path / "changes.geojson"
    flight = folder / "flight"
    done = run(
        *("localize", map_path, flight, "--out", tmp_path / "fixes.jsonl"),
        *("--registration", "off", "--report-changes", out),
    )
    assert done.code == 1 and "registration layer" in done.err
    assert not out.exists()
