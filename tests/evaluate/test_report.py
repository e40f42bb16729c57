"""The report: its page, its pictures as files, the table and the JSON values."""

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from erring_flights import CENTRE, flown

from html_page import Page
from orthonav.ground.evaluate.metrics import compare, measure
from orthonav.ground.evaluate.report import write_report
from orthonav.ground.evaluate.tables import (
    FlightReport,
    metrics_to_json,
    text,
)
from orthonav.ground.report import measure_text
from orthonav.ground.report.page import LIST

FIGURES = {"map", "error-over-time", "reliability"}


def made_flight(n: int, share_fixed: float = 0.9, name: str = "flight"):
    """A flight along a wave, one fix in ten far off, some views without a fix."""
    random, along = np.random.default_rng(3), np.linspace(0.0, 1.0, n)
    wrong = random.random(n) < 0.1
    errors = random.normal(0.0, 1.0, (n, 2)) * np.where(wrong, 600.0, 3.0)[:, None]
    found = random.random(n) < share_fixed
    sure = wrong & (np.arange(n) % 2 > 0)
    truth, results = flown(
        [tuple(error) if is_fix else None for error, is_fix in zip(errors, found, strict=True)],
        places_en_m=np.stack([1200 * along, 300 * np.sin(6 * along)], axis=1),
        confidence=np.where(sure, 0.95, random.uniform(0.35, 1.0, n)).tolist(),
        evidence=[{"lowe_ratio": 1.0 + each / 5} for each in random.random(n)],
    )
    comparison = compare(truth, results, CENTRE)
    return FlightReport(name, comparison, measure(comparison))


def stems(folder: Path) -> set[str]:
    found = {path.name for path in (folder / "figures").iterdir()} - {LIST}
    pairs = {Path(name).stem for name in found}
    assert found == {f"{stem}.{kind}" for stem in pairs for kind in ("svg", "png")}
    return pairs


def test_the_page_needs_nothing_from_outside_and_is_reproducible(tmp_path: Path, coarse) -> None:
    path = write_report(tmp_path / "report", [made_flight(40)])
    html = path.read_text(encoding="utf-8")
    page = Page(html)
    images = [found for tag, found in page.elements if tag == "img"]
    assert path == tmp_path / "report" / "index.html"
    assert sorted(p.name for p in path.parent.iterdir()) == ["figures", "index.html"]
    assert stems(path.parent) == FIGURES and len(images) == len(FIGURES)
    assert not re.search(r"https?:|url\(|@import|//www", html)
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.elements}
    assert all(image["src"].startswith("data:image/svg+xml;base64,") for image in images)
    assert all(image["alt"].startswith("flight: ") for image in images)
    write_report(tmp_path / "again", [made_flight(40)])
    first, second = (
        {each.name: each.read_bytes() for each in (tmp_path / name).rglob("*.*")}
        for name in ("report", "again")
    )
    assert first == second


@pytest.mark.long
def test_figures_follow_dark_mode_and_keep_legible_on_a_phone(tmp_path: Path, coarse) -> None:
    """A figure scrolls in its box: its text of 10 points is not made smaller than 11 pixels."""
    from benchmarks.browser import HOW_TO_GET_ONE, chromium, started

    if chromium() is None:
        pytest.skip(HOW_TO_GET_ONE)
    path = write_report(tmp_path / "report", [made_flight(40)])
    with started() as browser:
        for scheme, least, most in (("light", 250, 255), ("dark", 0, 40)):
            looks = {"color_scheme": scheme, "viewport": {"width": 390, "height": 844}}
            page = browser.new_page(**looks)
            page.goto(path.as_uri())
            figure = page.locator("figure img").first
            natural_px = float(figure.get_attribute("width") or 0)
            box = figure.bounding_box()
            assert box is not None and box["width"] > 0.7 * natural_px
            assert page.evaluate("document.documentElement.scrollWidth") == 390
            shot = np.frombuffer(figure.screenshot(), np.uint8)
            corner = cv2.imdecode(shot, cv2.IMREAD_COLOR)[10:30, 10:30]
            assert least <= corner.min() and corner.max() <= most, scheme


def test_the_page_holds_metrics_and_provenance(tmp_path: Path, no_plots) -> None:
    flight = made_flight(50)
    metrics = replace(flight.metrics, n_without_truth=3, n_without_result=2)
    flight = replace(flight, metrics=metrics)
    made_from = {"map": "brest.onav", "imagery": "ortho.tif", "command": "orthonav evaluate"}
    html = write_report(tmp_path, [flight], made_from).read_text("utf-8")
    metrics, worst = flight.metrics, int(np.nanargmax(flight.comparison.errors_m))
    assert f"<b>{100 * metrics.availability:.1f} %</b>" in html
    assert f'<b class="bad">{metrics.n_confident_wrong} of {metrics.n_confident}</b>' in html
    median = measure_text(metrics.standard.cep50_m)
    for cell in (median, flight.comparison.frames[worst], "blank"):
        assert f"<td>{cell}</td>" in html
    counted = "3 results have no true position", "2 true positions have no result"
    for said in (*counted, *made_from.values()):
        assert said in html


def test_protection_levels_are_drawn_where_they_are_known(tmp_path: Path, no_plots) -> None:
    flight = made_flight(30)
    fixes = np.isfinite(flight.comparison.errors_m)
    levels_m = np.where(fixes, np.where(np.arange(30) % 2, 20.0, np.inf), np.nan)
    comparison = replace(
        flight.comparison,
        place_probability=np.full(30, 0.9999),
        protection_levels_m=levels_m,
    )
    limited = replace(flight, comparison=comparison, metrics=measure(comparison, 15.0, 35.0))
    html = write_report(tmp_path, [limited]).read_text("utf-8")
    assert stems(tmp_path) == {*FIGURES, "stanford"}
    assert "<h3>Integrity</h3>" in html and "available at the alert limit of 35 m" in html
    counted = f"{np.isfinite(levels_m).sum()} of {fixes.sum()} fixes at a risk of 0.001"
    assert f"{counted}; the level of the others is infinite" in html


def test_several_runs_have_a_row_and_files_of_their_own(tmp_path: Path, no_plots) -> None:
    flights = [made_flight(n, name=name) for n, name in ((30, "../x"), (20, "a b"), (10, "a: b"))]
    page = write_report(tmp_path / "report", flights).read_text("utf-8")
    assert page.count("<img ") == 3 * len(FIGURES) and "Evaluation of 3 runs" in page
    rows = re.search(r'aria-label="runs"><table>.*?</table>', page, re.DOTALL)[0]
    assert re.findall(r"<tr><td>([^<]*)</td><td>(\d+)</td>", rows) == [
        ("../x", "30"),
        ("a b", "20"),
        ("a: b", "10"),
    ]
    assert page.count('class="answer') == 3 and "60" not in re.findall(r">(\d+)<", page)
    assert stems(tmp_path / "report") == {
        f"{name}--{figure}" for name in ("x", "a-b", "a-b-2") for figure in FIGURES
    }
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    assert page.count('href="#') == 3
    for place in re.findall(r'href="#([^"]+)"', page):
        assert page.count(f'id="{place}"') == 1
    levels = [int(level) for level in re.findall(r"<h(\d)", page)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))
    assert page.count("<table>") == page.count("aria-label") - 1


def test_a_flight_without_any_fix_is_reported(tmp_path: Path, coarse) -> None:
    flight = made_flight(1, share_fixed=0.0)
    html = write_report(tmp_path, [flight]).read_text("utf-8")
    assert "No view has a fix, so errors are not defined." in html
    assert "nan" not in re.sub(r"base64,[^\"]+", "", html).lower()
    assert "nan" not in text([flight]).lower()
    json.dumps(metrics_to_json(flight.metrics), allow_nan=False)
