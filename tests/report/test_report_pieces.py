"""Report pages, drawings as PNG and SVG, and figures as files."""

import base64
import hashlib
import re
import sys
from html import unescape
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from orthonav.core.errors import MissingExtraError, OutputError
from orthonav.ground.report import metres_text
from orthonav.ground.report.drawing import Background, Drawing, draw_axes, draw_map, map_size_in
from orthonav.ground.report.page import (
    LIST,
    Figure,
    file_names,
    joined_scripts,
    render,
    write_figures,
    write_page,
)


def figure(name: str, content: str = "a") -> Figure:
    drawing = Drawing(f"png {content}".encode(), f"<svg>{content}</svg>", (6.2, 4.0))
    return Figure(name, f"alt of {name}", f"caption of {name}", drawing)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "figures").iterdir())


def drawn_map() -> Drawing:
    box = (0.0, 900.0, 0.0, 600.0)
    background = Background(np.full((60, 90), 200, np.uint8), (0.0, 0.0, 900.0, 600.0))

    def draw(axes) -> None:
        draw_map(axes, box, background)
        axes.plot([100, 800], [100, 500], label="path < 1 & more")
        axes.legend()

    return draw_axes(map_size_in(box, 4.0), draw)


# Drawings.


def test_a_drawing_has_both_forms_and_its_text_is_text() -> None:
    drawing = drawn_map()
    image = cv2.imdecode(np.frombuffer(drawing.png, np.uint8), cv2.IMREAD_COLOR)
    assert drawing.size_in == (5.0, 4.0)
    assert image.shape == (880, 1100, 3)
    found = ElementTree.fromstring(drawing.svg).iter("{http://www.w3.org/2000/svg}text")
    texts = ["".join(each.itertext()) for each in found]
    assert {"N", "100 m", "east (m)", "path < 1 & more"} <= set(texts)


def test_characters_that_xml_forbids_are_replaced() -> None:
    drawing = draw_axes((3.0, 2.0), lambda axes: axes.set_title("a\x01b 日本", parse_math=False))
    assert "日本" in "".join(ElementTree.fromstring(drawing.svg).itertext())


def test_without_matplotlib_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'orthonav\[report\]'"):
        draw_axes((1.0, 1.0), lambda axes: None)


# Files.


def test_figures_are_replaced_whole_with_a_list_that_sha256sum_reads(tmp_path: Path) -> None:
    write_figures(tmp_path / "new", [figure("map"), figure("old")])
    write_figures(tmp_path / "new", [figure("map", "b"), figure("error-curve")])
    paths = sorted((tmp_path / "new" / "figures").glob("*.[ps][nv]g"))
    assert [p.name for p in paths] == ["error-curve.png", "error-curve.svg", "map.png", "map.svg"]
    assert paths[2].read_bytes() == b"png b" and paths[3].read_text() == "<svg>b</svg>"
    listed = (paths[0].parent / LIST).read_text().splitlines()
    found = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}" for p in paths]
    assert sorted(listed) == sorted(found)


def linked(svg: Path) -> None:
    svg.rename(svg.parent.parent / "outside.svg")
    svg.symlink_to(svg.parent.parent / "outside.svg")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda svg: svg.write_text("drawn over by hand"),
        lambda svg: svg.with_name("mine.png").write_bytes(b"mine"),
        lambda svg: svg.with_name(LIST).write_text("\0 forged\n"),
        linked,
    ],
    ids=["changed", "other", "unlisted", "linked"],
)
def test_a_folder_with_files_that_are_not_ours_is_refused(tmp_path: Path, spoil) -> None:
    write_page(tmp_path, "before", [figure("map")])
    spoil(tmp_path / "figures" / "map.svg")
    before = names(tmp_path)
    with pytest.raises(OutputError, match=r"figures$"):
        write_page(tmp_path, "after", [figure("map", "b")])
    assert names(tmp_path) == before and (tmp_path / "index.html").read_text() == "before"


def test_names_of_files_are_safe_and_differ() -> None:
    given = ["../x", "a b", "a  b", "A-B", "Île d'Yeu", "", "..", "é\udcff/\0", "日本", "x" * 300]
    made = file_names(given)
    assert made[:5] == ["x", "a-b", "a-b-2", "A-B-3", "Ile-d-Yeu"]
    assert made[5:9] == ["flight", "flight-2", "e", "flight-3"] and len(made[9]) == 80
    assert len({name.lower() for name in made}) == len(given)
    assert not [name for name in made if "--" in name]
    assert file_names(["a", "a", "a-2"]) == ["a", "a-2", "a-2-2"]


# The page.


PAGE = """{% extends "base.html" %}{% import "macros.html" as m %}{% block body %}
{{ m.cards([(nasty, nasty)]) }}{{ m.table((nasty,), [(nasty,), (nasty,)], nasty) }}
{{ m.definitions([(nasty, nasty), ("left out", "")], text=true) }}{{ m.figures([figure], 1) }}
{% endblock %}"""


@pytest.fixture
def rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Function that renders a page with every macro."""
    package = tmp_path / "page_of_a_test"
    (package / "templates").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "templates" / "page.html").write_text(PAGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, package.name, raising=False)  # of another test's folder

    def render_page(text: str, **more) -> str:
        drawn = Figure("map", text, text, figure("map").drawing)
        values = {"title": text, "kind": text, "nasty": text, "figure": drawn}
        return render(package.name, "page.html", values, **more)

    return render_page


def test_a_page_is_complete_and_its_text_is_escaped(rendered) -> None:
    page = rendered('<b onclick="x">&')
    assert "<b onclick" not in page and 'x"' not in page.replace("x&#34;", "")
    assert page.count("<h1>") == 1 and '<html lang="en">' in page
    assert page.index("<header") < page.index("<main>") < page.index("<h1>")
    assert 'width="682" height="440"' in page and 'class="broad"' in page
    assert "@media print" in page and "prefers-color-scheme: dark" in page
    assert "left out" not in page


def test_only_the_scripts_and_the_style_of_a_page_may_run(rendered) -> None:
    page = rendered("a", style="p { color: red; }", scripts=["let x = 1 < 2;"])
    policy = unescape(re.search(r'Policy" content="([^"]*)"', page)[1])
    assert "default-src 'none'" in policy and "unsafe" not in policy
    for kind in ("style", "script"):
        text = re.search(f"<{kind}>(.*?)</{kind}>", page, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert "script-src 'none'" in unescape(rendered("a"))


def test_scripts_of_a_page_are_joined_without_module_syntax() -> None:
    text = joined_scripts(("format.js", "plane.js", "chart.js"), "orthonav.ground.report", ())
    assert text.startswith("(() => {") and "function metres(" in text
    assert not re.search(r"^(export|import)\b", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0 m"),
        (3.26, "3.3 m"),
        (35.0, "35 m"),
        (99.97, "100 m"),
        (120.4, "120 m"),
        (12_345.0, "12.3 km"),
        (np.nan, "-"),
        (np.inf, "-"),
    ],
)
def test_lengths_have_one_form(value: float, text: str) -> None:
    assert metres_text(value) == text
