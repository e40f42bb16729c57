"""The page as people have it: drawn, reached by keys and by touch, in a real browser."""

import json

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from benchmarks.browser import HOW_TO_GET_ONE, chromium, started
from browsing import LAPTOP, TABLET, Visit, painted
from playwright.sync_api import expect
from small_run import CHUNK_PX, FRAME, GSD_M, PLACES_EN_M, WRONG, name, result, serving

from orthonav.core.flight.fixes import result_to_json, write_results
from orthonav.ground.report import metres_text
from orthonav.ground.view.run import ViewRequest, open_run

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
    return opened.news(0, 0, 0)["columns"]


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
    write_results(second, [result(i) for i in range(WRONG)])
    request = ViewRequest(small.fixes, small.map_path, second=second, flight=small.flight)
    with serving(open_run(request)) as started:
        page = visit(started)
        page.pictured(0)
        assert "second run: tracked.jsonl" in page.locator("#legend").inner_text()
        assert page.locator("#list .second").all_inner_texts()[WRONG] == "no fix"
        assert " / " in page.locator("#figures").inner_text()
        before = page.locator("#img-view").bounding_box()["width"]
        page.click("#enlarge")
        assert page.locator("#img-view").bounding_box()["width"] > 1.3 * before
        page.click("#copy")
        fix = json.loads(small.fixes.read_text().splitlines()[0])
        expect(page.locator("#ground")).to_contain_text(
            f"{fix['lat_deg']:.7f}, {fix['lon_deg']:.7f}"
        )


def test_the_worst_view_with_its_images_and_values(page, small, ask):
    page.select_option("#order", "error")
    page.chosen(WRONG, COUNT)
    first = page.locator("#list button").first
    expect(first).to_contain_text(name(WRONG)) and expect(first).to_contain_text("60 m confident!")
    show_wrong(page)
    assert page.locator("#list button").count() == 1
    assert page.locator("#shown-count").inner_text() == f"1 of {COUNT} views"
    fix = json.loads(small.fixes.read_text().splitlines()[WRONG])
    said = page.locator("#sentence").inner_text()
    spread_m = np.sqrt(np.linalg.eigvalsh(fix["cov_en_m2"])[-1])
    east_m, north_m = FRAME.en_from_latlon(fix["lat_deg"], fix["lon_deg"])
    error_m = np.hypot(east_m - PLACES_EN_M[WRONG][0], north_m - PLACES_EN_M[WRONG][1])
    for part in (
        f"tracking, confident, error {metres_text(error_m)}, FALSE FIX",
        f"confidence {fix['confidence']:.3f} within {metres_text(fix['radius_m'])}",
        f"\N{GREEK SMALL LETTER SIGMA} {metres_text(spread_m)}, heading {fix['heading_deg']:.1f}°",
        f"{metres_text(fix['agl_m'])} above ground",
    ):
        assert part in said
    page.click("#more summary")
    known = page.locator("#known").inner_text()
    assert f"{fix['lat_deg']:.7f}, {fix['lon_deg']:.7f}" in known and fix["time_s"] == 103
    side_px = json.loads(ask(f"/api/views/{WRONG}")[2])["window"]["size_px"]
    for shown in ("view", "fix", "over", "truth"):
        width = page.js(f"document.querySelector('#img-{shown}').naturalWidth")
        assert width == side_px, shown


def test_the_view_lies_over_the_map(page):
    """A right view looks as the map below it, a wrong one does not."""
    page.locator("#opacity").fill("100")
    over = page.locator(".leaflet-views-pane img")
    for i, low, high in ((2, 0.7, 1.0), (WRONG, -1.0, 0.5)):
        page.locator(f"#list [data-view='{i}']").click()
        page.pictured(i)
        page.keyboard.press("z")
        page.settled()
        expect(over).to_have_css("opacity", "1")
        with_view = page.picture(clip=below_the_middle(over)).mean(axis=-1)
        clip = below_the_middle(over)
        page.keyboard.press("o")
        expect(over).to_have_count(0)
        page.settled()
        without = page.picture(clip=clip).mean(axis=-1)
        page.keyboard.press("o")
        alike = np.corrcoef(with_view.ravel(), without.ravel())[0, 1]
        assert low < alike < high and np.abs(with_view - without).max() > 2, i


def below_the_middle(over):
    """A part of the view where no marks are."""
    box = over.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    return {"x": x - 60, "y": y + 30, "width": 120, "height": 60}


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


def test_dragging_over_the_course_and_clicking_on_the_map(page, columns):
    box = page.locator("#chart").bounding_box()
    left, middle = box["x"] + 52, box["y"] + box["height"] / 2
    wide = box["width"] - 60
    page.mouse.move(left + 0.42 * wide, middle)
    page.mouse.down()
    page.chosen(2, COUNT)
    page.mouse.move(left + 0.78 * wide, middle, steps=4)
    page.chosen(4, COUNT)
    page.mouse.up()
    page.mouse.move(left + 0.2 * wide, middle)
    page.chosen(4, COUNT)
    page.mouse.click(*page.on_screen((columns["x"][1], columns["y"][1]), CHUNK_PX))
    page.chosen(1, COUNT)
    page.click("#zoom-in")
    page.keyboard.press("End")  # brought into the part of the time that is seen
    page.chosen(COUNT - 1, COUNT)


def fits(page):
    """Nothing is wider than the screen or than its box (newer Chromiums count the border too)."""
    wide = page.js(
        """() => [...document.querySelectorAll(
          "body, header, main, aside, section, button, select, .row, dl, p, h2")]
        .filter((each) => each.checkVisibility() && !each.closest("#map"))
        .filter((each) => each.getBoundingClientRect().right > innerWidth + 0.5
          || each.clientWidth > 0 && each.scrollWidth > each.clientWidth + 2)
        .map((each) => each.id || each.outerHTML.slice(0, 80))"""
    )
    assert wide == [] and page.js("document.documentElement.scrollWidth <= innerWidth")


def test_on_a_tablet_by_touch(visit, server, columns):
    page = visit(server, **TABLET)
    page.chosen(0, COUNT)
    page.select_option("#order", "error")
    page.locator(f"#list [data-view='{WRONG}']").tap()
    page.chosen(WRONG, COUNT)
    expect(page.locator("#img-truth")).to_be_visible()
    page.settled()
    fits(page)
    screen = TABLET["viewport"]["height"]
    for part in ("#time-part", "#chosen", "#map-part"):
        page.locator(part).scroll_into_view_if_needed()
        assert page.locator("#time-part").bounding_box()["y"] < screen - 100
    small = page.js(
        """() => [...document.querySelectorAll(
          "button, select, input:not([type=checkbox]), .check, .leaflet-bar a")]
        .filter((each) => each.checkVisibility() && each.getBoundingClientRect().height < 43.5)
        .map((each) => each.id || each.outerHTML.slice(0, 80))"""
    )
    assert small == []
    page.js("scrollTo(0, 0)")
    box = page.locator("#chart").bounding_box()
    page.touchscreen.tap(box["x"] + 52 + 0.4 * (box["width"] - 60), box["y"] + 40)
    page.chosen(2, COUNT)
    page.touchscreen.tap(*page.on_screen((columns["x"][1], columns["y"][1]), CHUNK_PX))
    page.chosen(1, COUNT)
    page.locator("#after").tap()
    page.chosen(2, COUNT)


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


def test_a_run_is_followed_from_before_its_beginning(visit, small, tmp_path):
    """New views appear; the newest is followed until another is selected, and again on demand."""
    fixes = tmp_path / "live.jsonl"
    lines = [result_to_json(result(i)) + "\n" for i in range(COUNT)]
    run = open_run(ViewRequest(fixes, small.map_path, flight=small.flight, live=True))
    with serving(run) as server:
        page = visit(server)
        live = page.locator("#live")
        expect(live).to_have_text("live: waiting for the first view")
        fixes.write_text(lines[0] + lines[1])
        page.chosen(1, 2)
        expect(live).to_have_text("live")
        expect(page.locator("#newest")).to_be_checked()
        with fixes.open("a") as out:
            out.write('{"health": "DEGRADED", "reasons": ["searching"]}\n' + lines[2])
        page.chosen(2, 3)
        expect(page.locator("#health-now")).to_have_text("health DEGRADED: searching")
        page.settled()
        place = page.on_screen(((PLACES_EN_M[2][0] + 180) / GSD_M, (160 - 30) / GSD_M), CHUNK_PX)
        assert painted(page.picture(), page.colour("strong"), place, 14) > 60  # its ring
        page.keyboard.press("Home")
        expect(page.locator("#newest")).not_to_be_checked()
        with fixes.open("a") as out:
            out.write(lines[3])
        expect(page.locator("#shown-count")).to_have_text("4 views")
        page.locator("#newest").check()
        page.chosen(3, 4)
        page.keyboard.press("Home")
        page.pictured(0)  # else the images of view 3 may be those from before
        page.keyboard.press("End")
        expect(page.locator("#newest")).to_be_checked()
        page.pictured(3)
        fixes.write_text(lines[4])  # started over
        page.chosen(0, 1)
        expect(page.locator("#sentence")).to_contain_text("no fix: blank")
        page.pictured(0)
        expect(page.locator("#figure-fix")).to_be_hidden()
        page.settled()
        fixes.write_text("")
        expect(live).to_have_text("live: waiting for the first view")
        expect(page.locator("#chosen-name")).to_have_text("No view yet")
        expect(page.locator("#compare")).to_be_hidden()
        assert page.locator("#sentence").inner_text() == ""
