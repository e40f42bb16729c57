"""Pieces of a self-contained HTML page: no script, nothing from outside, light and dark.

All text is escaped here, except what is HTML already: the `body` of a document and what is put
into `pictures`, both made of these pieces.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from orthonav.report.figures import Figure
from orthonav.report.style import STYLE

_PX_PER_IN = 110
"""Pixels of the page for an inch of a drawing, where there is room for it."""


def document(title: str, body: str, style: str = STYLE, kind: str = "Report") -> str:
    """A whole page: a line with the project and the `kind` of page, `title` as the one heading of
    the first order, and `body`, which is HTML already and has headings from the second order on.
    """
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} - orthonav</title>\n<style>{style}</style>\n</head>\n"
        f'<body>\n<header class="top"><p><b>orthonav</b> <span>{escape(kind)}</span></p></header>\n'
        f"<main>\n<h1>{escape(title)}</h1>\n{body}\n</main>\n</body>\n</html>\n"
    )


def cards(shown: Iterable[tuple[str, str]]) -> str:
    """The few figures that matter most, large: (value, what it is). Six fill a line."""
    inside = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(said)}</span></div>" for value, said in shown
    )
    return f'<div class="cards">{inside}</div>'


def notes(said: Iterable[str]) -> str:
    """Sentences set off from the rest, each on its own; empty for none."""
    return "".join(f'<p class="note">{escape(sentence)}</p>' for sentence in said)


def html_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    last_is_total: bool = False,
    label: str = "table",
) -> str:
    """A table that scrolls sideways where it is too wide; the last row may be set off.

    `label` says what it is to who hears the page.
    """
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    lines = []
    for i, row in enumerate(rows):
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        is_total = last_is_total and i == len(rows) - 1
        lines.append(f'<tr class="total">{cells}</tr>' if is_total else f"<tr>{cells}</tr>")
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(label)}"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def figure_html(figure: Figure, broad: bool = False) -> str:
    """A figure inside the page, with a text for who cannot see it and its caption below.

    It is embedded as PNG, which looks the same with the fonts of any machine. `broad` ones fill a
    line of `pictures`.
    """
    width, height = (round(side * _PX_PER_IN) for side in figure.drawing.size_in)
    data = base64.b64encode(figure.drawing.png).decode("ascii")
    kind = ' class="broad"' if broad else ""
    return (
        f'<figure{kind}><img alt="{escape(figure.alt)}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{data}"><figcaption>{escape(figure.caption)}</figcaption></figure>'
    )


def pictures(shown: Iterable[str]) -> str:
    """What `figure_html` made, two in a line where there is room and they are not broad."""
    return f'<div class="pictures">{"".join(shown)}</div>'


def definitions(said: Mapping[str, str], sentences: bool = False) -> str:
    """Names and what they are, one per line; empty for none. Sentences need `SAID_STYLE`."""
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in said.items())
    kind = ' class="said"' if sentences else ""
    return f"<dl{kind}>{rows}</dl>" if rows else ""
