"""Links between pages lead to files and headings that are there, on the host as in the site."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)\)")


def prose(page):
    """Text of a page without its code."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`", lambda code: re.sub(r"[\[\]()]", "", code[0]), text)


def anchors(page):
    """What headings are called in an address."""
    headings = re.findall(r"^#{1,6} +(.+)$", prose(page), flags=re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.strip().replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, heading = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.is_file(), f"{link} leads nowhere"
        assert not heading or heading in anchors(target), f"{link}: no such heading"


def test_reference_pages_say_in_the_repository_what_the_site_shows():
    """Directives, which only the site understands, are comments; every name stands in the text."""
    for page in PAGES:
        text = page.read_text("utf-8")
        seen = re.sub(r"<!-- site\n.*?\n-->", "", text, flags=re.DOTALL)
        assert not re.search(r"^```\{", seen, re.MULTILINE), page
        for name in re.findall(r"^\.\. auto\w+:: orthonav\.(\w+)", text, re.MULTILINE):
            assert re.search(rf"`{name}\b", seen), f"{page}: {name}"
