"""`docs/paper-results.md`: tables of the rows in the repository, and of the further experiments."""

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.record import Table

from experiments.paper import words
from experiments.paper.methods import BETWEEN_DATES, SETTINGS
from experiments.paper.results import Result, percent
from experiments.paper.tables import tables

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper-results.md"
FIGURES = ("canny", "learnt", "share_canny", "share_learnt")
HEAD = """# Results of the paper's experiments

Made by `python -m experiments.paper keep` from `experiments/paper/rows`; do not edit. [The paper's
experiments](paper.md) has the protocol, the scenes and the discussion. Generated landscapes: seed
1. `python -m experiments.paper report --out experiments/paper/rows` adds tables of thresholds and
rules of position, and other imagery along the route and anywhere.
"""
ONLY_IN_REPORTS = (
    "Accepted at",
    "Rules of position",
    "Table 2: accuracy at 15 m, %: other imagery",
)


def page(rows: Sequence[Result]) -> str:
    """Text of the page: tables of each setting."""
    text = [HEAD]
    for name in SETTINGS:
        found = [row for row in rows if row.plain["setting"]["name"] == name]
        if found:
            text.append(f"## The {name} setting\n")
            shown = [each for each in tables(found) if not each.title.startswith(ONLY_IN_REPORTS)]
            text += [table.markdown() for table in shown]
    text += [agreement().markdown(), words.table().markdown()]
    return "\n".join(text)


def agreement() -> Table:
    """How the edges of two dates agree on landscapes that the network was not learnt from."""
    found = json.loads(BETWEEN_DATES.with_suffix(".json").read_text(encoding="utf-8"))
    rows = []
    for gsd_m in sorted({each["gsd_m"] for each in found}):
        pairs = [each for each in found if each["gsd_m"] == gsd_m]
        mean = {name: sum(each[name] for each in pairs) / len(pairs) for name in FIGURES}
        correlations = (f"{mean[name]:.2f}" for name in FIGURES[:2])
        rows.append([f"{gsd_m:g}", *correlations, *(percent(mean[name]) for name in FIGURES[2:])])
    notes = (
        "correlation of the edges of two dates, smoothed by a Gaussian of 1 px, mean of three "
        "pairs; density: pixels that are edges, in %; generated landscapes that were not learnt "
        "from",
        "made by `python -m experiments.paper.between_dates` at d63ac91",
    )
    header = ("m per pixel", "Canny", "learnt", "density Canny", "density learnt")
    return Table("Edges between dates", header, rows, notes)
