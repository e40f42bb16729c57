"""The gate: rows of the compact part against figures that are kept in `gate.json`, and tracks
against their single views.

For each row: `views` of it; `median_m` and `of_right` (share of the right fixes that are
confident) as renewed; `exceeded` protection levels; `nees`, the band of its mean, where it is not
the usual one. No confident fix may be false.
"""

import json
from pathlib import Path
from typing import Any

from benchmarks.real_ground import pairs
from benchmarks.real_ground.pairs import LEAST_M
from benchmarks.record import Section, Table, number

PATH = Path(__file__).with_suffix(".json")
SHARE = 0.1
"""A median is worse beyond its figure by this share and `LEAST_M`, which few views vary by."""
LEAST_OF_RIGHT = 0.1
"""So much less of the right fixes may be confident: else a model that accepts nothing passes."""
NEES = 0.1, 3.5
HEADER = ("row", "figure", "value", "allowed")
Figures = dict[str, dict[str, Any]]


def figures(path: Path = PATH) -> Figures:
    found: Figures = json.loads(path.read_text(encoding="utf-8"))
    return found


def write(made: Figures, path: Path = PATH) -> None:
    lines = (f" {json.dumps(name)}: {json.dumps(row)}" for name, row in made.items())
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def renewed(kept: Figures, values: Figures) -> Figures:
    """The figures by what was measured; views and bands stay."""
    made = {}
    for name, figure in kept.items():
        found = values.get(name)
        if found is not None:
            figure = figure | {
                "median_m": None if found["median_m"] is None else round(found["median_m"], 2),
                "of_right": round(found["of_right"], 2),
                "exceeded": found["exceeded"],
            }
        made[name] = figure
    return made


def failures(kept: Figures, values: Figures) -> list[list[str]]:
    """Rows under `HEADER` of what is worse than its figure."""
    return [line for name, figure in kept.items() for line in _worse(name, figure, values)]


def _worse(name: str, figure: dict[str, Any], values: Figures) -> list[list[str]]:
    found = values.get(name)
    if found is None:
        return [[name, "row", "missing", "there"]]
    if found["median_m"] is None:  # as where nothing says how the camera is tilted
        none = figure.get("median_m", 0.0) is None
        return [] if none else [[name, "confident fixes", "none", "some"]]
    made = []
    if found["false"]:
        made.append([name, "false", str(found["false"]), "0"])
    median_m = figure.get("median_m")
    limit_m = LEAST_M + (1 + SHARE) * (median_m or 0.0)
    if median_m is not None and found["median_m"] > limit_m:
        made.append([name, "median m", number(found["median_m"]), f"to {number(limit_m)}"])
    low, high = figure.get("nees", NEES)
    if not low <= found["nees"] <= high:
        made.append([name, "NEES", number(found["nees"]), f"{low:g} to {high:g}"])
    if found["exceeded"] > figure.get("exceeded", 0):
        allowed = str(figure.get("exceeded", 0))
        made.append([name, "protection levels exceeded", str(found["exceeded"]), f"to {allowed}"])
    least = figure.get("of_right", 0.0) - LEAST_OF_RIGHT
    if found["of_right"] < least:
        made.append([name, "confident of right", f"{found['of_right']:.2f}", f"from {least:.2f}"])
    return made


def judged(kept: Figures, values: Figures, tables: list[Table]) -> Section:
    """The section of a run of the gate, failed where a figure or a track is worse."""
    worse = [*failures(kept, values), *pairs.failures(pairs.paired(values))]
    return verdict("Gate of real ground", worse, tables)


def verdict(title: str, worse: list[list[str]], tables: list[Table]) -> Section:
    """A section, failed with a table where something is worse."""
    if not worse:
        return Section(f"{title}: passed", tables)
    rows = len({line[0] for line in worse})
    failed = Table(f"Failed rows: {rows}", HEADER, worse)
    return Section(f"{title}: failed", [*tables, failed], failed=True)
