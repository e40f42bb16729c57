"""The page `docs/paper-results.md`: all tables, from the rows in the repository alone."""

import json
from collections.abc import Iterator, Sequence

from benchmarks.record import Table

from experiments.paper.methods import BETWEEN_DATES
from experiments.paper.results import Result, percent
from experiments.paper.scenes import SEED
from experiments.paper.stored import ROOT, expected, made_at, name_of, older
from experiments.paper.tables import tables
from experiments.paper.trainings import trainings
from experiments.paper.trajectories import REDUCED, SETTINGS

PAGE = ROOT / "docs" / "paper-results.md"
HEAD = f"""# Results of the paper's experiments

Made by `python -m experiments.paper keep` from `experiments/paper/rows`; do not edit.
[The paper's experiments](paper.md) has the protocol and the discussion. Generated landscapes:
seed {SEED}.
"""


def page(rows: Sequence[Result], others: Sequence[Result] = ()) -> str:
    """Text of the page: tables of each setting, other trainings, and the rows that are missing."""
    text = [HEAD]
    for name in SETTINGS:
        found = [row for row in rows if row.plain["setting"]["name"] == name]
        if found:
            text.append(f"## The {name} setting\n")
            text += [table.markdown() for table in tables(found)]
    text.append(agreement().markdown())
    if others:
        text.append("## Other trainings\n")
        text.append(trainings(others, rows).markdown())
    if names := missing(rows):
        lines = "\n".join(f"- `{name}`" for name in names)
        text.append(f"## Rows of the reduced setting without a stored result\n\n{lines}\n")
    return "\n".join(text)


def agreement() -> Table:
    """How the edges of two dates agree on landscapes that the network was not learnt from."""
    found = json.loads(BETWEEN_DATES.with_suffix(".json").read_text(encoding="utf-8"))
    rows = [
        [
            *(f"{each['gsd_m']:g}", " and ".join(each["dates"])),
            *(f"{each[name]:.2f}" for name in ("canny", "learnt")),
            *(percent(each[name]) for name in ("share_canny", "share_learnt")),
        ]
        for each in found
    ]
    notes = (
        "correlation of the edges of two dates, smoothed by a Gaussian of 1 px; share: of pixels "
        "that are edges, in %; generated landscapes that were not learnt from",
        "made by python -m experiments.paper.between_dates",
    )
    header = ("m per pixel", "dates", "Canny", "learnt", "share Canny", "share learnt")
    return Table("Edges between dates", header, rows, notes)


def missing(rows: Sequence[Result]) -> list[str]:
    """Names of the rows of the reduced setting that have no stored result."""
    names = {name_of(row) for row in rows if row.plain["setting"]["name"] == REDUCED.name}
    return [name for name in expected() if name not in names]


def state(rows: Sequence[Result]) -> Iterator[str]:
    """One line for each row that is older than its code, and one naming those without result."""
    for row in rows:
        if changed := older(row):
            yield f"{name_of(row)} ({made_at(row)}) is older than {', '.join(changed)}"
    if names := missing(rows):
        yield f"without a stored result: {', '.join(names)}"
