"""The page `docs/paper-results.md`: all tables, from the rows in the repository alone."""

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.record import Table

from experiments.paper.methods import BETWEEN_DATES
from experiments.paper.results import Result, percent
from experiments.paper.scenes import SEED
from experiments.paper.tables import tables
from experiments.paper.trajectories import SETTINGS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper-results.md"
FIGURES = ("canny", "learnt", "share_canny", "share_learnt")
HEAD = f"""# Results of the paper's experiments

Made by `python -m experiments.paper keep` from `experiments/paper/rows`; do not edit. [The paper's
experiments](paper.md) has the protocol, the scenes and the discussion. Generated landscapes: seed
{SEED}.
"""


def page(rows: Sequence[Result]) -> str:
    """Text of the page: tables of each setting."""
    text = [HEAD]
    for name in SETTINGS:
        found = [row for row in rows if row.plain["setting"]["name"] == name]
        if found:
            text.append(f"## The {name} setting\n")
            text += [table.markdown() for table in tables(found)]
    text.append(agreement().markdown())
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
        "made by `python -m experiments.paper.between_dates`",
    )
    header = ("m per pixel", "Canny", "learnt", "density Canny", "density learnt")
    return Table("Edges between dates", header, rows, notes)
