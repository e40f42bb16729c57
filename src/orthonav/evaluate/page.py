"""Pieces of a self-contained HTML page: no script, nothing from outside, light and dark.

All text is escaped here, except the `body` of a document, which is made of these pieces.
"""

import base64
from collections.abc import Mapping, Sequence
from html import escape

STYLE = """
:root { color-scheme: light dark; --ink: #1d2329; --soft: #5c6670; --line: #d9dee3;
  --paper: #ffffff; --card: #f4f6f8; --mark: #0072b2; --warn: #fff3d6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --soft: #9aa5b0; --line: #353d45;
  --paper: #14181c; --card: #1e242a; --mark: #56b4e9; --warn: #3d331a; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 1rem; }
h2 { font-size: 1.3rem; margin: 2.5rem 0 .75rem; padding-bottom: .25rem;
  border-bottom: 2px solid var(--line); overflow-wrap: anywhere; }
h3 { font-size: 1.05rem; margin: 1.75rem 0 .5rem; }
.cards { display: grid; grid-template-columns: repeat(6, 1fr); gap: .75rem; }
@media (max-width: 960px) { .cards { grid-template-columns: repeat(3, 1fr); } }
@media (max-width: 520px) { .cards { grid-template-columns: repeat(2, 1fr); } }
.cards div { background: var(--card); border-radius: 10px; padding: .8rem 1rem; }
.cards b { display: block; font-size: 1.6rem; line-height: 1.2; color: var(--mark);
  font-variant-numeric: tabular-nums; }
.cards span, .small, figcaption { color: var(--soft); font-size: .88rem; }
.note { background: var(--warn); border-radius: 8px; padding: .5rem .9rem; margin: .75rem 0 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .35rem .6rem; text-align: right; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th { color: var(--soft); font-weight: 600; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.total td { font-weight: 700; border-top: 2px solid var(--line); }
.pictures { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1rem; }
figure { margin: 0; }
.pictures:not(.even) figure:nth-child(-n+2) { grid-column: 1 / -1; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; background: #fff;
  border: 1px solid var(--line); border-radius: 8px; padding: .4rem; }
figcaption { padding: .35rem .2rem 0; text-align: center; }
@media (max-width: 900px) { .pictures { grid-template-columns: 1fr; } }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.25rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; font-family: ui-monospace, Menlo, Consolas, monospace;
  font-size: .9rem; }
"""
SAID_STYLE = """
dl.said dd { font: inherit; font-variant-numeric: tabular-nums; }
"""
"""Beside `STYLE`, for definitions that are sentences."""


def document(title: str, body: str, style: str = STYLE) -> str:
    """A whole page around `body`, which is HTML already."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def html_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], last_is_total: bool = False
) -> str:
    """A table that scrolls sideways where it is too wide; the last row may be set off."""
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    lines = []
    for i, row in enumerate(rows):
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        is_total = last_is_total and i == len(rows) - 1
        lines.append(f'<tr class="total">{cells}</tr>' if is_total else f"<tr>{cells}</tr>")
    body = "".join(lines)
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def picture(png: bytes, alt: str, caption: str) -> str:
    """A PNG inside the page, with a text for who cannot see it and one below it."""
    data = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img alt="{escape(alt)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def definitions(said: Mapping[str, str], sentences: bool = False) -> str:
    """Names and what they are, one per line; empty for none. Sentences need `SAID_STYLE`."""
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in said.items())
    kind = ' class="said"' if sentences else ""
    return f"<dl{kind}>{rows}</dl>" if rows else ""
