"""The report page, its pictures, the table and the JSON values."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.evaluate import plots
from orthonav.ground.evaluate.metrics import compare, measure
from orthonav.ground.evaluate.report import MadeFrom, write_report
from orthonav.ground.evaluate.tables import (
    FlightReport,
    covariance_card,
    metrics_to_json,
    table,
    total,
)
from orthonav.ground.report.drawing import Background, Drawing
from orthonav.ground.report.numbers import measure_text

CENTRE = LocalFrame(48.0, -4.5)
PICTURES_PER_FLIGHT = 6
PICTURES_OF_ALL = 4


def made_flight(n: int, share_fixed: float = 0.9, name: str = "flight", seed: int = 3):
    """A flight along a wave, one fix in ten far off, some views without a fix."""
    random = np.random.default_rng(seed)
    along = np.linspace(0.0, 1.0, n)
    truth_en_m = np.stack([1200 * along, 300 * np.sin(6 * along)], axis=1)
    lat, lon = CENTRE.latlon_from_en(truth_en_m)
    truth = {f"{i:04d}.jpg": (float(lat[i]), float(lon[i])) for i in range(n)}
    results = []
    for i, frame in enumerate(truth):
        outcome: Fix | NoFix = NoFix("too_dark", "mean grey 3", {})
        if random.random() < share_fixed:
            wrong = random.random() < 0.1
            at = truth_en_m[i] + random.normal(0.0, 600.0 if wrong else 3.0, 2)
            fix_lat, fix_lon = (float(value) for value in CENTRE.latlon_from_en(at))
            ratio = 1.05 + random.random() * (0.2 if wrong else 2.0)
            known = {"peak_ratio": ratio, "lowe_ratio": 1.0 + random.random() / 5}
            confidence = min(ratio / 3, 1.0)
            confidence = 0.95 if wrong and i % 2 else confidence
            outcome = Fix(fix_lat, fix_lon, np.eye(2), confidence, 15.0, 0.0, 100.0, known)
        results.append(ViewResult(frame, i * 500_000_000, outcome, 40.0 + random.random()))
    comparison = compare(truth, results, CENTRE)
    return FlightReport(name, comparison, measure(comparison))


def noisy_background() -> Background:
    grey = np.random.default_rng(5).integers(0, 256, (900, 1700), dtype=np.uint8)
    return Background(grey, (-250.0, -450.0, 1450.0, 450.0))


class Page(HTMLParser):
    """What a page shows and what it asks for."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.addresses: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]


def test_the_page_needs_nothing_from_outside(tmp_path: Path, no_plots) -> None:
    path = write_report(tmp_path / "report", [made_flight(40)])
    html = path.read_text(encoding="utf-8")
    page = Page(html)
    assert path == tmp_path / "report" / "index.html"
    assert sorted(p.name for p in path.parent.iterdir()) == ["figures", "index.html"]
    assert not re.search(r"https?:|url\(|@import|//www", html)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert len(page.images) == PICTURES_PER_FLIGHT
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert all(image["alt"] for image in page.images)


def test_the_page_holds_metrics_and_provenance(tmp_path: Path, no_plots) -> None:
    flight = made_flight(50)
    made_from = MadeFrom(
        map_name="brest.onav",
        recipe="gradient:sigma_px=1.5",
        flight="logs/7",
        command="orthonav evaluate fixes.jsonl --truth truth.csv",
        version="0.1.0",
    )
    html = write_report(tmp_path, [flight], made_from).read_text("utf-8")
    assert "<h1>Evaluation of flight</h1>" in html
    metrics = flight.metrics
    assert f"<b>{100 * metrics.availability:.1f} %</b>" in html
    assert f'<b class="bad">{metrics.n_confident_wrong} of {metrics.n_confident}</b>' in html
    assert f"below {100 * metrics.wrong_upper_95:.1f} %" in html
    for figures in (metrics.of_confident, metrics.standard):
        assert f"<td>{measure_text(figures.cep50_m)}</td>" in html
    assert covariance_card(metrics.consistency)[1] in html
    for said in vars(made_from).values():
        assert said in html
    worst = flight.comparison.frames[int(np.nanargmax(flight.comparison.errors_m))]
    assert f"<td>{worst}</td>" in html
    assert "<td>too_dark</td>" in html
    assert "Lowe&#39;s ratio" in html


@pytest.mark.long
def test_text_is_escaped(tmp_path: Path, coarse) -> None:
    nasty = '<img src=x onerror="1">&$\\frac'
    flight = made_flight(12, name=nasty)
    frames = (f"{nasty}\udcff", *flight.comparison.frames[1:])
    flight = replace(flight, comparison=replace(flight.comparison, frames=frames))
    made_from = MadeFrom(map_name=nasty, command=nasty)
    html = write_report(tmp_path, [flight], made_from).read_text("utf-8")
    assert "<img src=x" not in html
    assert len(Page(html).images) == PICTURES_PER_FLIGHT


def test_several_flights_have_a_total(tmp_path: Path, no_plots) -> None:
    flights = [made_flight(30, name="one"), made_flight(20, name="two", seed=4)]
    whole = total(flights)
    assert whole.n_views == 50
    assert whole.n_fixes == sum(flight.metrics.n_fixes for flight in flights)
    html = write_report(tmp_path, flights).read_text("utf-8")
    assert len(Page(html).images) == 2 * PICTURES_PER_FLIGHT + PICTURES_OF_ALL
    assert '<tr class="total"><td>total</td><td>50</td>' in html


def test_flights_at_different_radii_have_no_total() -> None:
    one = made_flight(10)
    other = replace(one, metrics=measure(one.comparison, 50.0))
    with pytest.raises(ValueError, match="one radius"):
        total([one, other])
    with pytest.raises(ValueError, match="at least one flight"):
        total([])


def test_a_flight_without_any_fix_is_reported(tmp_path: Path, coarse) -> None:
    flight = made_flight(1, share_fixed=0.0)
    html = write_report(tmp_path, [flight]).read_text("utf-8")
    assert "No view has a fix" in html
    assert "nan" not in re.sub(r"base64,[^\"]+", "", html).lower()
    assert "nan" not in table([flight], flight.metrics).lower()
    json.dumps(metrics_to_json(flight.metrics), allow_nan=False)


def test_the_table_is_aligned() -> None:
    flights = [made_flight(30, name="one"), made_flight(5, 0.0, name="a longer name")]
    lines = table(flights, total(flights)).splitlines()
    header, *rows, rule, whole = lines
    assert header.split()[:4] == ["flight", "views", "confident", "wrong"]
    assert "acc@15 m" in header
    assert len(rows) == 2 and set(rule) == {"-"} and whole.startswith("total")
    assert len({len(line) for line in lines}) == 1
    assert len(table(flights[:1], flights[0].metrics).splitlines()) == 2


def decoded(drawing: Drawing) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(drawing.png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def has_colour(image: np.ndarray, colour: str) -> bool:
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((np.abs(image - wanted).max(axis=2) < 12).any())


def test_the_map_shows_right_and_wrong_and_the_background(monkeypatch) -> None:
    monkeypatch.setattr("orthonav.ground.report.drawing.DPI", 80)
    flight = made_flight(80)
    plain = decoded(plots.map_picture(flight.comparison, 15.0))
    over = decoded(plots.map_picture(flight.comparison, 15.0, noisy_background()))
    for image in (plain, over):
        for colour in (plots.RIGHT, plots.LOW_CONFIDENCE, plots.WRONG):
            assert has_colour(image, colour)
    assert np.ptp(over, axis=2).mean() < 40
    assert over.mean() < plain.mean() - 20


@pytest.mark.long
def test_matplotlib_is_imported_for_drawing_and_pyplot_never() -> None:
    code = (
        "import sys, orthonav.ground.evaluate.report\n"
        "unwanted = {'matplotlib', 'jinja2', 'PIL', 'torch', 'rasterio', 'pyproj'}\n"
        "assert not unwanted & set(sys.modules)\n"
        "from orthonav.ground.evaluate import metrics, plots\n"
        "from orthonav.core.records import NoFix, ViewResult\n"
        "result = ViewResult('a', 0, NoFix('blank', ''), 1.0)\n"
        "plots.map_picture(metrics.compare({'a': (48.0, -4.5)}, [result]), 15.0)\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
