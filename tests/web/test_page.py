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
needs_node = pytest.mark.skipif(NODE is None, reason="node is not installed")


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


def test_the_page_keeps_to_its_policy(page):
    """No scripts and styles inside the page: the server's policy forbids them."""
    for tag, attributes in page.elements:
        assert tag != "style" and "style" not in attributes
        assert tag != "script" or "src" in attributes
        assert not [each for each in attributes if each.startswith("on")]


def node(script, cwd):
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_node
def test_scripts_are_well_formed(tmp_path):
    for name, text in SCRIPTS.items():
        copy = tmp_path / name.replace(".js", ".mjs")
        copy.write_text(text, encoding="utf-8")
    read = "fs.readFileSync(f, 'utf8'), { identifier: f }"
    parse = f"process.argv.slice(1).forEach((f) => new vm.SourceTextModule({read}))"
    command = ["node", "--experimental-vm-modules", "-e", parse, *sorted(tmp_path.iterdir())]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


@needs_node
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
    found = np.array(json.loads(node(script, tmp_path)))
    east, north = np.array(px).T * [[GSD_M], [-GSD_M]] + [[WEST_M], [NORTH_M]]
    expected = np.stack(FRAME.latlon_from_en(np.stack([east, north], axis=-1)), axis=-1)
    assert np.abs(found - expected).max() < 1e-8


@needs_node
def test_views_are_filtered_and_ordered(tmp_path, opened):
    """The store of the page on a real answer: the worst come first, steps go over what is shown."""
    (tmp_path / "store.mjs").write_text(OURS["store.js"], encoding="utf-8")
    script = f"""
        import {{ Store }} from "./store.mjs";
        const store = new Store({json.dumps(opened.summary())});
        store.take({json.dumps(opened.news(0, 0, 0))});
        const said = {{ first: store.selected, stats: store.stats }};
        store.show({{ order: "error" }});
        said.worst = store.listed;
        store.show({{ which: "wrong", order: "time" }});
        said.wrong = store.listed;
        store.show({{ which: "confident" }});
        store.select(3); store.step(1); said.after = store.selected;
        store.step(1); store.step(1); said.last = store.selected;
        store.step(-1); said.before = store.selected;
        store.show({{ which: "reason:blank" }});
        said.blank = store.shown;
        store.select(2); store.step(1); said.next = store.selected;
        store.show({{ which: "all", named: "VIEW 02" }});
        said.named = store.shown;
        console.log(JSON.stringify(said));
    """
    said = json.loads(node(script, tmp_path))
    assert said["stats"] == {
        **{"fixes": 5, "confident": 5, "wrong": 1, "right": 4, "withTruth": 6},
        **{"withGnss": 0, "gnssAlarms": 0},
    }
    assert said["first"] == 0 and said["worst"] == [3, 0, 1, 2, 5, 4]
    assert said["wrong"] == [3] and said["blank"] == [4] and said["named"] == [2]
    assert (said["after"], said["last"], said["before"], said["next"]) == (5, 5, 3, 4)
