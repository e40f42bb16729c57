"""The page is whole: what it names is there, and nothing is from elsewhere."""

import json
import re
import shutil
import subprocess
from importlib.resources import files
from posixpath import dirname, join, normpath

import numpy as np
import pytest
from small_run import FRAME, GSD_M, NORTH_M, WEST_M

from html_page import Page
from orthonav.ground.report.page import static_text
from orthonav.ground.view.server import SHARED, load_assets

STATIC = files("orthonav.ground.view").joinpath("static")
OURS = {entry.name: entry.read_text(encoding="utf-8") for entry in STATIC.iterdir()}
OURS |= {name: static_text(name) for name in SHARED}
SCRIPTS = {name: text for name, text in OURS.items() if name.endswith(".js")}
NODE = shutil.which("node")


@pytest.fixture(scope="module")
def page():
    return Page(OURS["index.html"])


@pytest.fixture(scope="module")
def assets():
    return load_assets()


def named(page, *attributes):
    return [value[each] for _, value in page.elements for each in attributes if each in value]


def test_every_file_that_is_named_is_served(page, assets):
    asked = [join("/", path) for path in named(page, "src", "href")]
    for name, text in SCRIPTS.items():
        imports = re.findall(r'(?:import|from)\s+"([^"]+)"', text)
        asked += [normpath(join("/static", path)) for path in imports]
        assert all(path.startswith("./") or "leaflet" in path for path in imports), name
    styles = {"/static/style.css", "/leaflet/leaflet.css"}
    for style in styles:
        for path in re.findall(r"url\(([^)#]+)\)", assets[style].data.decode()):
            asked.append(normpath(join(dirname(style), path.strip("'\""))))
    assert styles < set(asked) and set(asked) <= set(assets)
    unused = {path for path in assets if path.startswith("/static/")} - set(asked)
    assert unused == set()


def test_nothing_is_from_elsewhere():
    for name, text in OURS.items():
        text = text.replace('xmlns="http://www.w3.org/2000/svg"', "")
        assert not re.search(r"\b(?:https?|wss?|ftp):|['\"(]//", text), name
        assert "eval(" not in text and "innerHTML" not in text, name


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_latitude_and_longitude_of_the_pointer(tmp_path):
    """Pixels to latitude and longitude, as `LocalFrame` has them, to a millimetre."""
    (tmp_path / "plane.mjs").write_text(OURS["plane.js"], encoding="utf-8")
    sheet = {"west_m": WEST_M, "north_m": NORTH_M, "gsd_m": GSD_M}
    sheet |= {"origin_lat_deg": FRAME.lat_deg, "origin_lon_deg": FRAME.lon_deg}
    px = [[0, 0], [700, 0], [350.5, 310.25], [40_000, -36_000], [360, 320]]
    script = f"""
        import {{ enFromPx, latLonFromEn }} from "./plane.mjs";
        const sheet = {json.dumps(sheet)};
        const places = {json.dumps(px)}.map((p) => latLonFromEn(sheet, ...enFromPx(sheet, ...p)));
        console.log(JSON.stringify(places));
    """
    command = [NODE, "--input-type=module", "-e", script]
    found = np.array(json.loads(subprocess.check_output(command, cwd=tmp_path, timeout=60)))
    east, north = np.array(px).T * [[GSD_M], [-GSD_M]] + [[WEST_M], [NORTH_M]]
    expected = np.stack(FRAME.latlon_from_en(np.stack([east, north], axis=-1)), axis=-1)
    assert np.abs(found - expected).max() < 1e-8
