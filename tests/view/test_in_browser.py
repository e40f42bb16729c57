"""The page as people have it: drawn, reached by keys and by touch, in a real browser."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from benchmarks.browser import HOW_TO_GET_ONE, chromium, started
from browsing import LAPTOP, Visit, painted
from playwright.sync_api import expect
from small_run import CHUNK_PX, NO_FIX, PLACES_EN_M, WRONG, name, result, serving

from orthonav.core.flight.fixes import write_results
from orthonav.ground.view.run import Run, ViewRequest

pytestmark = pytest.mark.long

COUNT = len(PLACES_EN_M)
MAIN_PARTS = ("header", "#map-part", "#chosen", "#list-part", "#health-part", "#time-part")


@pytest.fixture(scope="module")
def browser():
    if chromium() is None:
        pytest.skip(HOW_TO_GET_ONE)
    expect.set_options(timeout=120_000)  # only ends a hang
    with started() as found:
        yield found


@pytest.fixture
def visit(browser):
    """Function that opens a page; in the end nothing was wrong and nothing from elsewhere."""
    visits = []

    def opened(server, **options):
        visits.append(Visit(browser, server.url(), options))
        return visits[-1]

    yield opened
    for each in visits:
        each.context.close()
        each.was_well()


@pytest.fixture(scope="module")
def laptop(browser, server):
    found = Visit(browser, server.url(), LAPTOP)
    yield found
    found.context.close()


@pytest.fixture
def page(laptop):
    """The small run on a laptop, freshly opened, with all views."""
    laptop.again()
    laptop.chosen(0, COUNT)
    laptop.settled()
    yield laptop
    laptop.was_well()


@pytest.fixture(scope="module")
def columns(opened):
    return opened.views()["columns"]


def show_wrong(page):
    page.select_option("#which", "wrong")
    page.chosen(WRONG, COUNT)
    expect(page.locator("#img-truth")).to_be_visible()
    page.settled()


def test_the_run_is_drawn_where_it_is(page, columns):
    """Marks lie on the imagery where the fixes have them; nothing was asked of others."""
    assert page.title() == "fixes.jsonl \N{EN DASH} orthonav view"
    assert len(page.asked) > 20 and all(url.startswith("http://127.0.0.1:") for url in page.asked)
    tiles = page.js("[...document.querySelectorAll('.tile-part')].map((each) => each.naturalWidth)")
    assert len(tiles) >= 4 and min(tiles) > 0
    picture = page.picture()
    for i in (WRONG, COUNT - 1):
        place = page.on_screen((columns["x"][i], columns["y"][i]), CHUNK_PX)
        assert painted(picture, page.colour("confident"), place) > 15, i
        assert (painted(picture, page.colour("wrong"), place, 9) > 15) == (i == WRONG), i
    truth = np.stack([columns["tx"], columns["ty"]], axis=1)
    for between in (truth[2:] + truth[1:-1]) / 2:
        assert painted(picture, page.colour("truth"), page.on_screen(between, CHUNK_PX), 2) >= 2
    course = page.locator("#chart").bounding_box()
    part = page.picture(clip=course)
    assert painted(part, page.colour("confident")) > 2000  # the band of states
    assert painted(part, page.colour("wrong")) > 500  # the radius
    assert page.locator("#legend").inner_text().split("\n") == [
        "●confident",
        "●tracking",
        "—ground truth",
        "◯false fix",
    ]
    figures = page.locator("#figures").inner_text().replace("\n", " ")
    assert figures.startswith("views 6 confident 83.3 % low confidence 0.0 % no fix 16.7 % within")
    assert figures.endswith("false fixes 1")


def test_two_runs_enlarged_images_and_coordinates(visit, small, tmp_path):
    second = tmp_path / "tracked.jsonl"
    guess = replace(result(WRONG), frame=name(COUNT - 1), accepted=False)
    write_results(second, [*(result(i) for i in range(WRONG)), guess])
    request = ViewRequest(small.fixes, small.map_path, second=second, flight=small.flight)
    with serving(Run(request)) as started:
        page = visit(started)
        page.pictured(0)
        assert "second run: tracked.jsonl" in page.locator("#legend").inner_text()
        assert page.locator("#list .second").all_inner_texts()[WRONG] == "no fix"
        figures = page.locator("#figures").inner_text().replace("\n", " ")
        assert re.search(r"CEP95 of confident fixes \d\d(\.\d)? m / 0 m", figures), figures
        before = page.locator("#img-view").bounding_box()["width"]
        page.click("#enlarge")
        assert page.locator("#img-view").bounding_box()["width"] > 1.3 * before
        page.click("#copy")
        fix = json.loads(small.fixes.read_text().splitlines()[0])
        expect(page.locator("#ground")).to_contain_text(
            f"{fix['lat_deg']:.7f}, {fix['lon_deg']:.7f}"
        )


def test_a_view_as_recorded_beside_the_map_from_its_fix(page):
    show_wrong(page)
    page.keyboard.press("c")
    expect(page.locator("#img-view")).to_have_attribute("src", re.compile("raw.jpg"))
    expect(page.locator("#img-fix")).to_have_attribute("src", re.compile("map-in-view.png"))
    expect(page.locator("#figure-fix figcaption")).to_have_text("map seen from the fix")
    page.settled()
    view, over, fix = (
        page.locator(f"#img-{name}").bounding_box() for name in ("view", "over", "fix")
    )
    assert over == fix and fix["width"] == pytest.approx(view["width"], abs=1)
    assert fix["height"] == pytest.approx(fix["width"] * 240 / 320, abs=1)
    for part in ("#figure-truth", "#put", "#ring"):
        expect(page.locator(part)).to_be_hidden()
    page.select_option("#which", "none")
    page.pictured(NO_FIX)
    page.select_option("#which", "wrong")
    expect(page.locator("#img-fix")).to_have_attribute("src", re.compile(f"/{WRONG}/map-in-view"))
    page.click("#perspective")
    page.pictured(WRONG)
    expect(page.locator("#put")).to_be_visible()


def test_stepping_by_keys_is_seen_and_announced(page):
    said = page.locator("#sentence")
    assert said.get_attribute("aria-live") == "polite"
    steps = ["ArrowRight", "ArrowRight", "ArrowLeft", "End", "PageUp", "Home", "PageDown", "n", "p"]
    sentences = set()
    for key, i in zip(steps, [1, 2, 1, COUNT - 1, COUNT - 2, 0, 1, 2, 1], strict=True):
        page.keyboard.press(key)
        page.chosen(i, COUNT)
        assert page.locator("#scrub").input_value() == str(i)
        sentence = said.inner_text()
        assert page.locator("#scrub").get_attribute("aria-valuetext") == f"view {i + 1}: {sentence}"
        expect(page.locator("#list [aria-current]")).to_have_attribute("data-view", str(i))
        sentences.add(sentence)
    assert len(sentences) == 5
    expect(said).to_have_attribute("aria-busy", "false")
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-pressed", "true")
    page.chosen(COUNT - 1, COUNT)  # plays to the end and stops
    expect(page.locator("#play")).to_have_attribute("aria-pressed", "false")


def test_by_the_rules_of_axe(page):
    """Names, contrast, landmarks and the rest of axe-core, with a bad view and with help."""
    show_wrong(page)
    page.click("#more summary")
    assert axe_finds(page) == []
    page.emulate_media(color_scheme="dark")
    assert axe_finds(page, only=["color-contrast"]) == []
    page.click("#help-open")
    assert axe_finds(page, only=["color-contrast"]) == []
    page.emulate_media(color_scheme="light")
    assert axe_finds(page) == []


def axe_finds(page, only=None):
    options = {"resultTypes": ["violations"]} | ({"runOnly": only} if only else {})
    found = Axe().run(page.page, options=options).response
    assert "color-contrast" in {each["id"] for each in found["passes"]}
    return [
        f"{each['id']}: {node['html'][:160]} ({node['failureSummary'][:300]})"
        for each in found["violations"]
        for node in each["nodes"]
    ]
