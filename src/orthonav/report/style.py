"""How the pages of reports look: light, dark, narrow and printed."""

STYLE = """
:root { color-scheme: light dark; --ink: #1d2329; --soft: #56606a; --line: #d9dee3;
  --paper: #ffffff; --card: #f4f6f8; --mark: #0067a3; --warn: #fff3d6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --soft: #a3adb7; --line: #353d45;
  --paper: #14181c; --card: #1e242a; --mark: #56b4e9; --warn: #3d331a; } }
*, ::before { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
.top { border-bottom: 1px solid var(--line); background: var(--card); }
.top p { max-width: 1120px; margin: 0 auto; padding: .6rem 1.25rem; display: flex;
  justify-content: space-between; gap: 1rem; color: var(--soft); font-size: .92rem; }
.top b { color: var(--ink); letter-spacing: .02em; }
.top b::before { content: ""; display: inline-block; width: .8em; height: .8em;
  margin-right: .5em; border: .17em solid var(--mark); border-radius: 50%; }
main { max-width: 1120px; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 1rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 2.5rem 0 .75rem; padding-bottom: .25rem;
  border-bottom: 2px solid var(--line); overflow-wrap: anywhere; }
h3 { font-size: 1.05rem; margin: 1.75rem 0 .5rem; }
a { color: var(--mark); }
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
.wide + figure { margin-top: 1.25rem; }
.pictures .broad { grid-column: 1 / -1; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; background: #fff;
  border: 1px solid var(--line); border-radius: 8px; padding: .4rem; }
figcaption { padding: .35rem .2rem 0; text-align: center; }
@media (max-width: 900px) { .pictures { grid-template-columns: minmax(0, 1fr); } }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.25rem; }
dt { color: var(--soft); }
dd { margin: 0; overflow-wrap: anywhere; font-family: ui-monospace, Menlo, Consolas, monospace;
  font-size: .9rem; }
@media (max-width: 520px) { dl { grid-template-columns: 1fr; } dd { margin-bottom: .5rem; } }
@page { margin: 14mm; }
@media print {
  :root { color-scheme: light; --ink: #000; --soft: #444; --line: #bbb; --paper: #fff;
    --card: #fff; --mark: #00527f; --warn: #fff; }
  body { font-size: 10pt; }
  main, .top p { max-width: none; padding-left: 0; padding-right: 0; }
  .cards div, .note { border: 1px solid var(--line); }
  .wide { overflow: visible; }
  table { font-size: 8.5pt; }
  th, td { padding: .25rem .4rem; white-space: normal; }
  figure, tr, .cards, dl { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  figure img { max-height: 235mm; width: auto; }
}
"""
SAID_STYLE = """
dl.said dd { font: inherit; font-variant-numeric: tabular-nums; }
"""
"""Beside `STYLE`, for definitions that are sentences."""
