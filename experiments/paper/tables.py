"""Tables from result files alone: the paper's Tables 1 to 3 and Figure 3, costs.

`page` is `docs/paper-results.md`: tables of the rows in the repository and of the further
experiments. The paper's own figures are of other imagery: compare the order.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path

from benchmarks.record import Table, number

from experiments.paper import curves, dates, field, words
from experiments.paper.methods import CANNY, GREY, SAM, SEGMENTS, SETTINGS, STUDIED
from experiments.paper.results import (
    BASELINES,
    ORDER,
    Result,
    accepted_at,
    best_words,
    by_scene,
    ceiling,
    confident,
    difference,
    of_methods,
    percent,
    read,
    share,
)
from experiments.paper.scenes import PLACEMENTS
from orthonav.core.records import CONFIDENT

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper-results.md"
HEAD = """# Results of the paper's experiments

Made by `python -m experiments.paper keep` from `experiments/paper/rows`, files with commit, command
and versions of a row; do not edit. [The paper's experiments](paper.md) has protocol and discussion.
`python -m experiments.paper report --out experiments/paper/rows` adds tables of thresholds, rules
of position, rows above the default and other imagery.
"""
OTHER = "other imagery"
ONLY_IN_REPORTS = "Accepted at", "Rules of position", "Rows above", OTHER
TUNED = "*: tuned on this scene or on imagery of the same generator (docs/paper.md)"
TRAJECTORIES = "A", "B", "C", "D"
TABLE_2 = {
    ("bovw", GREY): (50.40, 23.92, 2.67, 1.20),
    ("triplet", GREY): (16.02, 82.16, 78.60, 54.21),
    ("triplet", CANNY): (43.91, 67.94, 85.28, 44.58),
    ("triplet", SAM): (12.42, 30.06, 78.26, 67.47),
    ("autoencoder", GREY): (86.24, 71.20, 92.00, 50.00),
    ("autoencoder", CANNY): (88.16, 90.20, 99.67, 88.10),
    ("autoencoder", SAM): (89.76, 90.40, 98.00, 83.33),
}
"""The paper's Table 2: accuracy at 15 m in per cent for A, B, C and D."""
TABLE_3 = {
    ("autoencoder", GREY): ((0, 0), (89.5, 72.8), (99.2, 91.3), (82.0, 46.4)),
    ("autoencoder", CANNY): ((96.0, 12.1), (99.7, 91.0), (98.6, 85.7), (100, 79.7)),
    ("autoencoder", SAM): ((95.0, 0.2), (96.4, 89.8), (99.3, 98.6), (100, 67.8)),
}
"""The paper's Table 3: accuracy and accepted share in per cent at Lowe's ratio 1.13."""
LOWE = 1.13
SHOWN_RULES = "product best", "product weighted", "cosine best", "cosine neighbours"
Cell = Callable[[Result], str]
Published = dict[tuple[str, str], tuple[str, ...]]
"""Cells of the paper for A to D, by family and input."""


def report(out: Path, setting: str) -> Path | None:
    """Write `tables.md` beside the result files; None without results."""
    results = read(out / setting)
    if not results:
        return None
    path = out / setting / "tables.md"
    text = "\n".join(table.markdown() for table in tables(results))
    path.write_text(text + "\n", encoding="utf-8")
    return path


def page(rows: Sequence[Result]) -> str:
    """Text of the page: tables of each setting; a note is shown once."""
    text, noted = [HEAD], set[str]()
    for name in SETTINGS:
        found = [row for row in rows if row.plain["setting"]["name"] == name]
        text += [f"## The {name} setting\n"] if found else []
        for table in tables(found) if found else ():
            if not any(part in table.title for part in ONLY_IN_REPORTS):
                notes = [note for note in table.notes if note not in noted]
                text.append(replace(table, notes=notes).markdown())
                noted.update(notes)
    return "\n".join([*text, words.table().markdown()])


def tables(results: Sequence[Result]) -> list[Table]:
    """All tables of results of one setting."""
    learning = curves.table(results)
    if learning:  # rows of one training share their label
        return [*learning, provenance(results)]
    made = of_methods(results)
    return [
        *scenes(made),
        *accuracy(made),
        *dates.table(made),
        *criterion(made),
        *accepted(made),
        *above_default(made),
        *rules(made),
        *sensitivity(made),
        *baselines(results),
        *field.tables(results),
        *costs(made),
        provenance(results),
    ]


def scenes(results: Sequence[Result]) -> list[Table]:
    """Size, resolution and numbers of views of each scene."""
    rows = []
    for scene, (first, *_) in by_scene(results).items():
        flown = first.trajectory
        views = "/".join(str(len(first.plain["views"][name])) for name in PLACEMENTS)
        size = [f"{flown.length_m:g} x {flown.band_m:g}", f"{flown.agl_m:g}"]
        grid = [f"{flown.gsd_m:g}", f"{first.plain['tiles']:,}"]
        rows.append([scene, *size, *grid, percent(ceiling(flown.stride_m)), views])
    header = ("scene", "area m", "height m", "m per pixel", "tiles", "upper bound %", "views")
    notes = (
        "upper bound: accuracy at 15 m, anywhere, of a method that always finds the correct tile; "
        "views: along the route (at most one per tile step), on the grid of tiles, anywhere",
    )
    return [Table("Table 1: trajectories and scenes", header, rows, notes)] if rows else []


def accuracy(results: Sequence[Result]) -> list[Table]:
    """Table 2: accuracy at 15 m by method and scene, for the three kinds of views."""

    def cell(each: Result) -> str:
        return _joined(each.accuracy(name) for name in PLACEMENTS)

    def chance(each: Result) -> str:
        return _joined(each.plain["chance"].get(name, math.nan) for name in PLACEMENTS)

    notes = ("views along the route / on the grid / anywhere", TUNED)
    paper = {key: tuple(f"{value:.1f}" for value in row) for key, row in TABLE_2.items()}
    return _by_scene("Table 2: accuracy at 15 m, %", results, cell, notes, paper, chance)


def criterion(results: Sequence[Result]) -> list[Table]:
    """Table 3: accuracy of the views that the confidence criterion accepts."""

    def cell(each: Result) -> str:
        name, threshold = "lowe_ratio", LOWE
        if each.method.registration:
            name, threshold = "confidence", CONFIDENT
        return _joined(confident(each.right("grid"), each.column("grid", name), threshold))

    notes = (
        "accuracy at 15 m of the accepted views / fraction accepted; views on the grid, whose "
        "accuracy without the criterion is in Table 2",
        f"criterion: Lowe's ratio of {LOWE}; orthonav, default: confidence {CONFIDENT:g}",
    )
    found = [each for each in results if each.method.family != "bovw"]
    paper = {key: tuple(f"{a:g}/{b:g}" for a, b in row) for key, row in TABLE_3.items()}
    return _by_scene("Table 3: with the criterion, %", found, cell, notes, paper)


def accepted(results: Sequence[Result]) -> list[Table]:
    """Views that can be accepted at 95 % correct, by Lowe's ratio and with an exclusion radius."""

    def cell(each: Result) -> str:
        right = each.right("grid")
        ratios = (each.column("grid", name) for name in ("lowe_ratio", "peak_ratio"))
        return _joined(accepted_at(right, ratio) for ratio in ratios)

    notes = (
        "largest fraction of the views on the grid that a threshold accepts with at least 95 % "
        "correct, chosen on the same views: Lowe's ratio / best score over the best one beyond "
        "half a tile",
    )
    found = [
        each
        for each in results
        if each.scene in TRAJECTORIES
        and each.method.family != "bovw"
        and not each.method.registration
    ]
    return _by_scene("Accepted at 95 % correct, %", found, cell, notes)


def _by_scene(
    title: str,
    results: Sequence[Result],
    cell: Cell,
    notes: Sequence[str],
    paper: Published | None = None,
    chance: Cell | None = None,
) -> list[Table]:
    """A table of the paper's trajectories and one of other imagery: methods by scenes."""
    made: list[Table] = []
    for papers, what in ((True, "trajectories"), (False, OTHER)):
        found = {s: rows for s, rows in by_scene(results).items() if (s in TRAJECTORIES) == papers}
        if found:
            rows = _rows(found, cell, paper or {})
            if chance:
                rows.append(["random tile", *(chance(each[0]) for each in found.values())])
            made.append(Table(f"{title}: {what}", ("method", *found), rows, notes))
    return made


def _rows(found: dict[str, list[Result]], cell: Cell, paper: Published) -> list[list[str]]:
    """A row of cells for each method, and below it the paper's figures."""
    shown = [each for results in found.values() for each in best_words(results)]
    rows = []
    for _, group in groupby(sorted(shown, key=ORDER), ORDER):
        placed = {each.scene: each for each in group}
        method = next(iter(placed.values())).method
        cells = {scene: cell(each) + each.star for scene, each in placed.items()}
        rows.append([method.label, *(cells.get(scene, "-") for scene in found)])
        stands_in = method.input in (SEGMENTS, f"{SAM}-tile")
        figures = paper.get((method.family, SAM if stands_in else method.input))
        by_name = dict(zip(TRAJECTORIES, figures or (), strict=False))
        if by_name.keys() & found.keys():
            known = " (Segment Anything)" if stands_in else ""
            rows.append([f"- in the paper{known}", *(by_name.get(scene, "-") for scene in found)])
    return rows


def _joined(fractions: Iterable[float]) -> str:
    return "/".join(map(percent, fractions))


def rules(results: Sequence[Result]) -> list[Table]:
    """Rules of position and similarities on one trajectory."""
    found = [each for each in results if each.plain.get("rules") and each.scene == STUDIED]
    if not found:
        return []
    rows = []
    for each in best_words(found):
        placed = [each.plain["rules"][placement] for placement in ("grid", "anywhere")]
        cells = (_joined(share(part[name]) for part in placed) for name in SHOWN_RULES)
        rows.append([each.label, *cells])
    notes = (
        "views on the grid / anywhere",
        "product: embeddings without scaling; cosine: the same, scaled to length 1; best: the "
        "paper; weighted: all tiles by score (Bianchi and Barfoot); neighbours: after Couturier "
        "and Akhloufi",
    )
    header = ("method", *SHOWN_RULES)
    return [Table(f"Rules of position, {STUDIED}: accuracy at 15 m, %", header, rows, notes)]


def sensitivity(results: Sequence[Result]) -> list[Table]:
    """Accuracy at each error of heading and height, on the trajectory that the paper sweeps."""
    swept = [each for each in best_words(results) if each.plain.get("sweep")]
    if not swept:
        return []
    turns, drops = (swept[0].plain["sweep"][name] for name in ("heading_deg", "drop_m"))
    names = [("heading_deg", each) for each in turns] + [("drop_m", each) for each in drops][1:]
    rows = [
        [each.label, *(percent(share(each.plain["sweep"][sweep][value])) for sweep, value in names)]
        for each in swept
    ]
    _, count = next(iter(turns.values()))
    notes = (
        f"{count} views on the grid of {swept[0].scene}; the default searches headings, the other "
        "methods take the reported one as exact",
    )
    header = ("method", *(f"{value} {'deg' if sweep[0] == 'h' else 'm'}" for sweep, value in names))
    title = "Figure 3: accuracy at 15 m, %, by orientation and by altitude drop"
    return [Table(title, header, rows, notes)]


def baselines(results: Sequence[Result]) -> list[Table]:
    """Methods that carry the reference images."""
    found = []
    for tried in (each for each in results if BASELINES in each.plain):
        rows = []
        for name, plain in tried.plain[BASELINES].items():
            grid, anywhere = (plain["views"][placement] for placement in ("grid", "anywhere"))
            cells = [percent(share(grid)), percent(share(anywhere)), str(anywhere[1])]
            rows.append([name, *cells, number(plain["view_ms"])])
        header = ("method", "on grid", "anywhere", "of", "ms per view")
        notes = ("they carry the orthophoto itself; reported pose, whole map, no prior",)
        title = f"Related work, {tried.scene}: accuracy at 15 m, %"
        found.append(Table(title, header, rows, notes))
    return found


def costs(results: Sequence[Result]) -> list[Table]:
    """Time to learn, size of the map, time of a view, on one scene."""
    found = by_scene(results)
    if not found:
        return []
    scene = STUDIED if STUDIED in found else next(iter(found))
    rows = []
    for each in best_words(found[scene]):
        plain = each.plain
        figures = [plain["learn_s"], plain["mb_per_km2"], plain["encoder_mb"], plain["view_ms"]]
        rows.append([each.label, *map(number, figures)])
    header = ("method", "learn s", "MB per km2", "encoder MB", "ms per view")
    notes = (
        "times: wall-clock, in the reduced setting two rows at a time; learn s: the encoder, with "
        "embedding all tiles; MB per km2: the map file less the encoder or vocabulary, which it "
        "holds once; ms: one view from its picture to the fix, one core",
    )
    return [Table(f"Cost, {scene}", header, rows, notes)]


def provenance(results: Sequence[Result]) -> Table:
    """Commit and day of the rows, and how many of them."""
    made: Counter[tuple[str, str]] = Counter()
    for each in results:
        about = each.plain["provenance"]
        commit = str(about["commit"])[:10] + (", with changes" if about["dirty"] else "")
        made[str(about["date"])[:10], commit] += 1
    rows = [[commit, day, str(count)] for (day, commit), count in sorted(made.items())]
    processors = ", ".join(sorted({str(each.plain["provenance"]["cpu"]) for each in results}))
    return Table("Measured at", ("commit", "date", "rows"), rows, (f"processor: {processors}",))


def above_default(results: Sequence[Result]) -> list[Table]:
    """Every row that locates more views within 15 m than orthonav's default on its scene."""
    rows, compared = [], 0
    for scene, found in by_scene(results).items():
        default = [each for each in found if each.method.registration]
        others = [each for each in best_words(found) if not each.method.registration]
        for ours, each, name in product(default, others, PLACEMENTS):
            compared += 1
            mean, error = difference(each, ours, name)
            if mean > 0:
                shares = [percent(one.accuracy(name)) for one in (ours, each)]
                size = "within the noise" if mean <= 2 * error else "significant"
                count = str(len(each.plain["views"][name]))
                rows.append([scene, name, count, shares[0], each.label, shares[1], size])
    if not rows:
        return []
    header = ("scene", "views", "of", "default", "method", "accuracy", "difference")
    notes = (
        f"accuracy at 15 m in %; the default is as good or better in {compared - len(rows)} of "
        f"{compared} comparisons",
        "within the noise: less than two standard errors of the difference",
    )
    return [Table("Rows above orthonav's default", header, rows, notes)]
