"""The folder of a report: the page, and its figures beside it."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.ground.evaluate.metrics import compare, measure
from orthonav.ground.evaluate.report import write_report
from orthonav.ground.evaluate.tables import FlightReport
from orthonav.ground.report.page import LIST

CENTRE = LocalFrame(48.0, -4.5)
FIGURES = {"map", "error-over-time", "reliability"}


def flown(name: str, times_ns: tuple[int, ...] = tuple(range(0, 12_000_000_000, 1_000_000_000))):
    """A flight to the east, every fourth view without a fix."""
    truth, results = {}, []
    for i, time_ns in enumerate(times_ns):
        lat, lon = (float(x) for x in CENTRE.latlon_from_en(np.array([20.0 * i, 0.0])))
        truth[f"{i}.jpg"] = (lat, lon)
        fix = Fix(lat + 1e-5, lon, np.eye(2), 0.9, 15.0, 0.0, 100.0, {"peak_ratio": 1.4})
        outcome = NoFix("blank", "") if i % 4 == 3 else fix
        results.append(ViewResult(f"{i}.jpg", time_ns, outcome, 40.0))
    comparison = compare(truth, results, CENTRE)
    return FlightReport(name, comparison, measure(comparison))


def stems(folder: Path) -> set[str]:
    found = {path.name for path in (folder / "figures").iterdir()} - {LIST}
    pairs = {Path(name).stem for name in found}
    assert found == {f"{stem}.{kind}" for stem in pairs for kind in ("svg", "png")}
    return pairs


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report, drawn once."""
    folder = tmp_path_factory.mktemp("drawn")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.report.drawing.DPI", 20)
        write_report(folder, [flown("one")])
    return folder


def test_every_figure_of_the_page_is_a_file(drawn: Path) -> None:
    page = (drawn / "index.html").read_text("utf-8")
    assert stems(drawn) == FIGURES
    assert page.count("<img") == len(FIGURES)
    for tag in re.findall(r"<img[^>]{0,400}", page):
        assert re.match(r'<img alt="one: [^"]{20,}" width="\d+" height="\d+" src="data:', tag)


@pytest.mark.long
def test_reports_are_reproducible(drawn: Path, tmp_path: Path, coarse) -> None:
    write_report(tmp_path / "again", [flown("one")])
    first, second = (
        {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (drawn, tmp_path / "again")
    )
    assert first == second and len(first) == 2 * len(FIGURES) + 2


def test_files_of_several_flights_carry_their_names(tmp_path: Path, no_plots) -> None:
    flights = [flown("../x"), flown("a b"), flown("a: b")]
    page = write_report(tmp_path / "report", flights).read_text("utf-8")
    assert stems(tmp_path / "report") == {
        f"{name}--{figure}" for name in ("x", "a-b", "a-b-2") for figure in FIGURES
    }
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    for place in re.findall(r'href="#([^"]+)"', page):
        assert page.count(f'id="{place}"') == 1
    assert page.count('href="#') == 3


def test_a_rerun_leaves_no_stale_figures_and_all_other_files(tmp_path: Path, no_plots) -> None:
    write_report(tmp_path, [flown("one"), flown("two")])
    (tmp_path / "notes.txt").write_text("mine")
    write_report(tmp_path, [flown("one")])
    assert stems(tmp_path) == FIGURES
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "figures",
        "index.html",
        "notes.txt",
    ]


def test_headings_are_in_order_and_tables_have_names(tmp_path: Path, no_plots) -> None:
    page = write_report(tmp_path, [flown("one"), flown("two")]).read_text("utf-8")
    levels = [int(level) for level in re.findall(r"<h(\d)", page)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))
    assert (
        'aria-label="table"' not in page and page.count("<table>") == page.count("aria-label") - 1
    )
    assert "<header" in page and "Evaluation of 2 flights" in page
