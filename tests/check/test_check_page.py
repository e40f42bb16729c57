"""The page of a check is complete, requests nothing, and works in a real browser."""

import base64
import hashlib
import json
import re
from dataclasses import replace

import cv2
import made_check
import numpy as np
import pytest
from made_check import EVIL, FILES, nearly_empty, small_route

from html_page import Page
from orthonav.ground.check.layers import check_to_plain
from orthonav.ground.check.records import CELL_VALUES
from orthonav.ground.check.wording import text
from orthonav.ground.check.write import write_check


def evil(frame):
    """A check whose names are markup."""
    names = dict.fromkeys(("map_name", "imagery", "route_name", "command"), EVIL)
    about = replace(made_check.tiny(frame).about, **names, terms=(EVIL,))
    return small_route(frame, about=about)


KINDS = {each.__name__: each for each in (made_check.tiny, small_route, nearly_empty, evil)}


@pytest.fixture(scope="module")
def folder(opened, frame, tmp_path_factory):
    """Checks of all kinds, by name."""
    root = tmp_path_factory.mktemp("checks")
    for name, make in KINDS.items():
        assert write_check(make(frame), opened, root / name) == root / name / "index.html"
    assert "\x1b" not in text(evil(frame))
    return root


@pytest.fixture(scope="module")
def page(folder):
    return Page((folder / "small_route" / "index.html").read_text(encoding="utf-8"))


def test_every_kind_of_check_is_written(folder):
    assert {path.name for path in folder.iterdir()} == set(KINDS)
    for each in folder.iterdir():
        assert {path.name for path in each.iterdir()} == FILES
        page = (each / "index.html").read_text(encoding="utf-8")
        assert len(page) < 4_000_000 and "<script>alert" not in page and "<img src=x" not in page
        for name in ("check.json", "check.geojson"):
            json.loads((each / name).read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_nothing_is_asked_for(page):
    for tag, attributes in page.elements:
        assert tag not in ("link", "iframe", "object", "base")
        for name in ("src", "href", "srcset", "data"):
            downloaded = "download" in attributes and attributes["href"] in FILES
            assert downloaded or attributes.get(name, "data:").startswith(("data:", "#")), (
                tag,
                name,
            )
        assert "style" not in attributes and not [n for n in attributes if n.startswith("on")]
    for style in page.texts["style"]:
        assert "@import" not in style
        assert all(each.startswith("data:") for each in re.findall(r"url\(([^)]*)\)", style))
    assert "sourceMappingURL" not in "".join(page.texts["script"])


def test_the_map_is_transparent_where_there_is_no_imagery(page):
    """So that its border is as dark as the page of a reader in dark mode."""
    sources = [attributes.get("src", "") for tag, attributes in page.elements if tag == "img"]
    data = base64.b64decode(sources[0].removeprefix("data:image/webp;base64,"))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(image[..., 3])) == {0, 255}


@pytest.mark.parametrize("name", KINDS)
def test_the_script_is_given_the_json_of_the_check(folder, frame, name):
    """Of the cells only the known ones: of others nothing is known, and none was tried."""
    page = Page((folder / name / "index.html").read_text(encoding="utf-8"))
    plain, whole = json.loads(page.texts["script"][0]), check_to_plain(KINDS[name](frame))
    assert (plain.pop("drawn")["route"] is None) == (name in ("tiny", "nearly_empty"))
    known = plain["cells"].pop("known")
    for values in CELL_VALUES:
        cells = np.array(whole["cells"].pop(values)).ravel()
        assert plain["cells"].pop(values) == cells[known].tolist()
        assert set(np.delete(cells, known)) <= ({0} if values == "trials" else {None})
    assert plain == json.loads(json.dumps(whole))


def test_who_signs_sees_what_was_checked(folder):
    text = (folder / "small_route" / "index.html").read_text(encoding="utf-8")
    signed = text[text.index("Sign-off") :]
    digest = hashlib.sha256((folder / "small_route" / "check.json").read_bytes()).hexdigest()
    for said in (made_check.DIGEST, digest, "orthonav check area.onav", "Organisation"):
        assert said in signed


# In a browser


@pytest.fixture(scope="module")
def browser():
    from benchmarks.browser import HOW_TO_GET_ONE, chromium, started

    if chromium() is None:
        pytest.skip(HOW_TO_GET_ONE)
    with started() as found:
        yield found


@pytest.fixture
def visit(browser, folder):
    """Function that opens the page of a check; in the end nothing was wrong, nothing asked for."""
    contexts, wrong = [], []

    def opened(name, **options):
        context = browser.new_context(**{"viewport": {"width": 1366, "height": 900}, **options})
        context.set_default_timeout(120_000)  # only ends a hang
        contexts.append(context)
        found = context.new_page()
        path = folder / name / "index.html"
        found.on("console", lambda message: wrong.append(message.text))
        found.on("pageerror", lambda error: wrong.append(str(error)))
        found.on("dialog", lambda dialog: wrong.append(dialog.message))
        context.route(
            re.compile("^(?!data:)(?!.*index.html$)"), lambda route: wrong.append(route.request.url)
        )
        found.goto(path.as_uri())
        return found

    yield opened
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.mark.long
@pytest.mark.parametrize("name", ["evil", "nearly_empty"])
def test_the_page_comes_alive(visit, name):
    page = visit(name)
    assert page.locator("html.live").count() == 1
    assert page.locator("#map .leaflet-image-layer").count() == 2
    assert page.locator("#map .leaflet-control-scale-line").inner_text()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for name in ("low", "error_m", "wrong", "persistence", ""):
        page.select_option("#layer", name)


@pytest.mark.long
def test_the_printed_page_has_map_and_profile(visit):
    page = visit("small_route")
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    for part in ("#map", "#profile", ".sign"):
        assert page.locator(part).is_visible()
    assert not page.locator(".tools").is_visible()
    assert page.locator("#map").bounding_box()["width"] < 700


def test_the_panel_says_what_is_in_the_cell(visit, frame):
    page = visit("tiny")
    page.focus("#map")
    page.keyboard.press("Enter")
    said = page.locator("#announcement").inner_text()
    result = made_check.tiny(frame)
    middle = result.cells.probability[6:8, 6:8].ravel()
    shown = float(re.search(r"probability: (\d+) %", said)[1]) / 100
    assert np.abs(middle - shown).min() < 0.008
    lat, lon = map(float, re.search(r"place: ([-\d.]+), ([-\d.]+)", said).groups())
    assert np.abs(frame.en_from_latlon(lat, lon)).max() < 15


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_rules_of_accessibility(visit, scheme):
    from axe_playwright_python.sync_playwright import Axe

    page = visit("small_route", bypass_csp=True, color_scheme=scheme)
    found = Axe().run(page).response["violations"]
    assert [(each["id"], each["nodes"][0]["html"]) for each in found] == []
