"""The server answers what the page asks for, only that, and only to the page."""

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from blots import GROUND
from small_run import (
    CHUNK_PX,
    FRAME,
    GSD_M,
    NO_FIX,
    NORTH_M,
    PLACES_EN_M,
    WEST_M,
    WRONG,
    name,
    plane,
    result,
    write_small_map,
)

from orthonav.core.errors import MissingExtraError, OutputError
from orthonav.core.flight.gnss import FAULTS
from orthonav.ground.view.run import Run, ViewRequest, columns_of
from orthonav.ground.view.server import Pages, Server, is_loopback, load_assets


def as_json(reply):
    status, headers, body = reply
    assert status == 200 and headers["content-type"] == "application/json"
    return json.loads(body)


def as_picture(reply):
    status, headers, body = reply
    assert status == 200 and headers["content-type"].startswith("image/")
    return cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)


def test_the_summary_says_what_is_shown(ask):
    found = as_json(ask("/api/run"))
    assert found["name"] == "fixes.jsonl" and found["map_name"] == "area.onav"
    assert found["images"] == "flight" and found["truth"] == "flight"
    assert found["states"] == ["searching", "tracking", "coasting", "lost"]
    sheet = found["sheet"]
    assert (sheet["west_m"], sheet["north_m"], sheet["gsd_m"]) == (WEST_M, NORTH_M, GSD_M)
    assert sheet["tiles"]["side_px"] == CHUNK_PX and sheet["tiles"]["levels"][0] == [620, 700]


def test_views_come_as_columns(ask):
    views = as_json(ask("/api/views"))
    columns = views["columns"]
    assert views["health"] == views["problems"] == []
    assert {len(column) for column in columns.values()} == {6}
    assert columns["frame"] == [name(i) for i in range(6)]
    assert columns["t"] == [0, 1, 2, 3, 4, 5] and columns["head"][1] == 50
    assert columns["reason"][NO_FIX] == "blank" and columns["x"][NO_FIX] is None
    assert columns["err"][0] == 0 and columns["err"][WRONG] == 60
    assert columns["wrong"] == [0, 0, 0, 1, 0, 0] and columns["state"] == [1] * 6
    sizes = np.sqrt(np.linalg.eigvalsh([[9.0, 4.0], [4.0, 16.0]]))
    assert (columns["b"][0], columns["a"][0]) == pytest.approx(sizes, abs=0.01)
    assert columns["turn"][0] == pytest.approx(np.degrees(np.arctan2(8, -7)) / 2, abs=0.1)


def gnss_view(number, off_en_m=None, fault=0.0, **fix):
    """A view whose GNSS is so far off its fix."""
    evidence = {"gnss_fault": fault}
    if off_en_m is not None:
        place = FRAME.latlon_from_en(np.add(PLACES_EN_M[0], off_en_m))
        evidence |= dict(zip(("gnss_lat_deg", "gnss_lon_deg"), map(float, place), strict=True))
    plain = result(0)
    outcome = replace(plain.outcome, evidence=evidence, **fix)
    return replace(plain, frame=f"{number}", outcome=outcome)


def test_the_protection_level_is_that_of_the_risk_of_the_run(opened):
    sure = replace(gnss_view(0, place_probability=0.9999), risk=0.01)
    columns = columns_of([sure, gnss_view(1)], {}, opened.sheet, 15.0)
    level_m = sure.outcome.protection_level_m(0.01)
    assert columns["level"] == [pytest.approx(level_m, abs=0.1), None]  # none at 0.95
    assert columns["risk"] == [0.01, 1e-3]


def test_gnss_is_shown_beside_the_fix(opened):
    drift = float(FAULTS.index("gnss_drift") + 1)
    results = [gnss_view(0, (3.0, 4.0)), gnss_view(1, (30.0, 40.0), drift), gnss_view(2)]
    east_m, north_m = PLACES_EN_M[0]
    truth = {"0": tuple(map(float, FRAME.latlon_from_en((east_m, north_m + 4.0))))}
    columns = columns_of(results, truth, opened.sheet, 15.0)
    assert columns["gdiff"] == [5.0, 50.0, None] and columns["gerr"] == [3.0, None, None]
    assert columns["gfault"] == ["", "gnss_drift", ""]
    assert columns["gx"][0] == pytest.approx((east_m + 3.0 - WEST_M) / GSD_M, abs=0.02)
    assert columns["gy"][0] == pytest.approx((NORTH_M - north_m - 4.0) / GSD_M, abs=0.02)


def test_a_tile_is_the_chunk_of_its_place(ask):
    """The pixel of a tile shows the ground at its place, on every level."""
    for level, col, row in ((0, 1, 0), (0, 2, 1), (1, 0, 1), (2, 0, 0)):
        tile = as_picture(ask(f"/tiles/{level}/{col}/{row}"))
        height, width = tile.shape[:2]
        east, north = plane(1024 >> level, 1024 >> level, level)
        part = np.s_[row * CHUNK_PX :, col * CHUNK_PX :]
        expected = GROUND(east[part][:height, :width], north[part][:height, :width])
        if tile.ndim == 3:  # with a mask
            seen, tile = tile[..., 3] > 0, tile[..., 0]
        else:
            seen = np.ones(tile.shape, bool)
        off = np.abs(tile - np.clip(expected, 0, 255))[seen]
        assert seen.any() and np.mean(off) < 6 + 3 * level


def test_a_view_lies_on_the_map_where_its_fix_has_it(ask):
    """Turned by the heading and tilted, a right one shows the ground of the map, a wrong not."""
    for i in (0, WRONG):
        window = as_json(ask(f"/api/views/{i}"))["window"]
        view = as_picture(ask(f"/api/views/{i}/view.png"))
        put = as_picture(ask(f"/api/views/{i}/map-fix.png"))
        taken = as_picture(ask(f"/api/views/{i}/map-truth.png"))
        assert view.shape == (window["size_px"], window["size_px"], 4)
        assert window["side_m"] / window["size_px"] <= GSD_M
        seen = view[..., 3] > 0
        assert 0.3 < seen.mean() < 0.9
        grey = view[..., 0][seen]
        at_truth = np.corrcoef(grey, np.atleast_3d(taken)[..., 0][seen])[0, 1]
        at_fix = np.corrcoef(grey, np.atleast_3d(put)[..., 0][seen])[0, 1]
        assert at_truth > 0.97
        assert at_fix > 0.97 if i == 0 else at_fix < 0.4


def test_the_detail_says_all(ask):
    found = as_json(ask("/api/views/0"))
    assert found["time_s"] == "100.000000000" and found["evidence"] == {"score": 0.5}
    assert found["telemetry"]["pitch_deg"] == 4.0
    place_en_m = FRAME.en_from_latlon(found["lat_deg"], found["lon_deg"])
    assert place_en_m == pytest.approx(PLACES_EN_M[0], abs=1e-3)
    nothing = as_json(ask(f"/api/views/{NO_FIX}"))
    assert nothing["reason"] == "blank" and "window" in nothing and "lat_deg" not in nothing
    assert ask(f"/api/views/{NO_FIX}/map-fix.png")[0] == 404
    assert as_picture(ask(f"/api/views/{NO_FIX}/raw.jpg")).shape == (240, 320)


@pytest.mark.parametrize(
    "path",
    [
        "/nothing",
        "/static/",
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        "/static/..%2fserver.py",
        "/static//etc/passwd",
        "/leaflet/leaflet.js",
        "/tiles/0/99/0",
        "/tiles/-1/0/0",
        "/api/views/6",
        "/api/views/12345678901234567890",
        "/api/views/0/map-elsewhere.png",
        "/preview.jpg",
    ],
)
def test_nothing_else_is_served(ask, path):
    status, _, body = ask(path)
    assert status == 404 and len(body) < 200 and b"Traceback" not in body


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example:80", "localhost.evil.example", "", "192.0.2.7"]
)
def test_another_host_name_is_refused(ask, server, host):
    """A page of another site whose name was made to lead here sees nothing."""
    status, _, body = ask("/api/run", Host=host)
    assert status == 421 and b"fixes" not in body


def test_pages_of_other_sites_get_nothing(ask):
    for path in ("/api/run", "/static/main.js", "/tiles/0/0/0"):
        assert ask(path, Sec_Fetch_Site="cross-site")[0] == 403
        assert ask(path, Sec_Fetch_Site="same-site")[0] == 403
        status, headers, _ = ask(path, Sec_Fetch_Site="same-origin", Origin="http://evil.example")
        assert status == 200 and not [h for h in headers if h.startswith("access-control")]
        assert headers["cross-origin-resource-policy"] == "same-origin"
    assert ask("/", Sec_Fetch_Site="cross-site")[0] == 200  # a link may be followed


@pytest.mark.parametrize("method", ["POST", "PUT", "OPTIONS"])
def test_it_only_reads(ask, method):
    status, _, body = ask("/api/run", method)
    assert status == 501 and b"fixes" not in body
    assert ask("/api/run", "HEAD")[::2] == (200, b"")


def test_it_listens_on_the_loopback_under_its_names(server):
    assert server.server_address[0] == "127.0.0.1"
    assert server.url() == f"http://127.0.0.1:{server.server_port}/"
    assert all(map(is_loopback, ("localhost", "LocalHost:8000", "127.0.0.1:1", "[::1]:2")))


def test_a_port_that_is_taken(opened, server):
    with pytest.raises(OutputError, match="cannot listen"):
        Server(Pages(opened, {}), port=server.server_port)


def test_without_leaflet_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "xstatic.pkg.leaflet", None)
    with pytest.raises(MissingExtraError, match=r"orthonav\[web\]"):
        load_assets()


def test_a_map_without_layer_shows_its_preview(small, tmp_path):
    path = write_small_map(tmp_path / "plain.onav", layer=False)
    run = Run(ViewRequest(small.fixes, path, flight=small.flight))
    pages = Pages(run, {})
    assert json.loads(pages.answer("/api/run").data)["sheet"]["tiles"] is None
    assert pages.answer("/preview.jpg").media_type == "image/jpeg"
    assert pages.answer("/tiles/0/0/0").status == 404
    cut = pages.answer("/api/views/0/map-truth.png").data
    view = cv2.imdecode(np.frombuffer(pages.answer("/api/views/0/view.png").data, np.uint8), -1)
    ground = cv2.imdecode(np.frombuffer(cut, np.uint8), 0)
    seen = view[..., 3] > 0
    assert np.corrcoef(view[..., 0][seen], ground[seen])[0, 1] > 0.9
