"""Tables of one setting from result files alone: the paper's Tables 1 to 3 and Figure 3, costs."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby, product
from pathlib import Path

from benchmarks.record import Table, number

from experiments.paper import curves, dates, field
from experiments.paper.methods import DEFAULT, STUDIED
from experiments.paper.published import (
    LOWE,
    TRAJECTORIES,
    published_accuracy,
    published_criterion,
    stands_for,
)
from experiments.paper.results import (
    BASELINES,
    ORDER,
    PROGRAM,
    Result,
    accepted_at,
    best_words,
    by_scene,
    ceiling,
    confident,
    difference,
    name_of,
    of_methods,
    percent,
    read,
    share,
)
from experiments.paper.scenes import PLACEMENTS
from orthonav.core.records import CONFIDENT

TUNED = "*: tuned on this scene or on imagery of the same generator (docs/paper.md)"
SHOWN_RULES = ("product best", "product weighted", "cosine best", "cosine neighbours")
STEPS = (("heading_deg", "orientation, deg"), ("drop_m", "altitude drop, m"))
Cell = Callable[[Result], str]
Published = Callable[[str, str, str], str]
"""The paper's figure of a family, an input and a scene."""


def report(out: Path, setting: str) -> Path | None:
    """Write `tables.md` beside the result files; None without results."""
    folder = out / setting
    results = read(folder)
    if not results:
        return None
    path = folder / "tables.md"
    text = "\n".join(table.markdown() for table in tables(results))
    path.write_text(text + "\n", encoding="utf-8")
    return path


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
        *baselines(results, made),
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
        grid = [f"{flown.gsd_m:g}", f"{first.plain['tiles']:,}", f"{flown.stride_m:g}"]
        rows.append([scene, *size, *grid, percent(ceiling(flown.stride_m)), views])
    header = (
        *("scene", "area m", "height m", "m per pixel", "tiles", "tile step m"),
        *("upper bound %", "views"),
    )
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
    title = "Table 2: accuracy at 15 m, %"
    return _by_scene(title, results, cell, notes, published_accuracy, chance)


def criterion(results: Sequence[Result]) -> list[Table]:
    """Table 3: accuracy of the views that the confidence criterion accepts."""

    def cell(each: Result) -> str:
        name, threshold = ("lowe_ratio", LOWE)
        if each.method.registration:
            name, threshold = "confidence", CONFIDENT
        return _joined(confident(each.right("grid"), each.column("grid", name), threshold))

    notes = (
        "accuracy at 15 m of the accepted views / fraction accepted; views on the grid, whose "
        "accuracy without the criterion is in Table 2",
        f"criterion: Lowe's ratio of {LOWE}; orthonav, default: confidence {CONFIDENT:g}",
    )
    found = [each for each in results if each.method.family != "bovw"]
    return _by_scene("Table 3: with the criterion, %", found, cell, notes, published_criterion)


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
    for papers, what in ((True, "trajectories"), (False, "other imagery")):
        found = {s: rows for s, rows in by_scene(results).items() if (s in TRAJECTORIES) == papers}
        if found:
            rows = _rows(found, cell, paper)
            if chance:
                rows.append(["random tile", *(chance(each[0]) for each in found.values())])
            made.append(Table(f"{title}: {what}", ("method", *found), rows, () if made else notes))
    return made


def _rows(found: dict[str, list[Result]], cell: Cell, paper: Published | None) -> list[list[str]]:
    """A row of cells for each method, and below it the paper's figures."""
    shown = [each for results in found.values() for each in best_words(results)]
    rows = []
    for _, group in groupby(sorted(shown, key=ORDER), ORDER):
        placed = {each.scene: each for each in group}
        method = next(iter(placed.values())).method
        cells = {scene: cell(each) + each.star for scene, each in placed.items()}
        rows.append([method.label, *(cells.get(scene, "-") for scene in found)])
        figures = [paper(method.family, method.input, scene) for scene in found] if paper else []
        if any(each != "-" for each in figures):
            known = " (Segment Anything)" if stands_for(method.input) != method.input else ""
            rows.append([f"- in the paper{known}", *figures])
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
    made: list[Table] = []
    swept = [each for each in best_words(results) if each.plain.get("sweep")]
    for step, title in STEPS if swept else ():
        found = [each.plain["sweep"][step] for each in swept]
        counts = [[percent(share(each[value])) for value in found[0]] for each in found]
        rows = [[each.label, *cells] for each, cells in zip(swept, counts, strict=True)]
        _, count = next(iter(found[0].values()))
        notes = (
            f"{count} views on the grid of {swept[0].scene}; the default searches headings, "
            "the other methods take the reported one as exact",
        )
        header = ("method", *found[0])
        made.append(Table(f"Figure 3: accuracy at 15 m, %, by {title}", header, rows, notes))
    return made


def baselines(results: Sequence[Result], made: Sequence[Result]) -> list[Table]:
    """Methods that carry the reference images, and orthonav on the same trajectory."""
    found = []
    for tried in (each for each in results if BASELINES in each.plain):
        rows = []
        for name, plain in tried.plain[BASELINES].items():
            grid, anywhere = (plain["views"][placement] for placement in ("grid", "anywhere"))
            cells = [percent(share(grid)), percent(share(anywhere)), str(anywhere[1])]
            rows.append([name, *cells, number(plain["view_ms"])])
        for each in made:
            if each.method.family == DEFAULT and each.scene == tried.scene:
                cells = [percent(each.accuracy(name)) for name in ("grid", "anywhere")]
                cells.append(str(len(each.plain["views"]["anywhere"])))
                rows.append([each.label, *cells, number(each.plain["view_ms"])])
        header = ("method", "on grid", "anywhere", "of", "ms per view")
        notes = ("the baselines carry the orthophoto itself; reported pose, whole map, no prior",)
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
    """Commit, day, command and core minutes of the rows."""
    made: dict[tuple[str, str, str], list[Result]] = {}
    for each in sorted(results, key=name_of):
        about = each.plain["provenance"]
        commit = str(about["commit"])[:10] + (", changed" if about["dirty"] else "")
        key = (str(about["date"])[:10], commit, str(each.plain.get("command", PROGRAM)))
        made.setdefault(key, []).append(each)
    rows = []
    for (day, commit, command), found in sorted(made.items()):
        minutes = sum(each.plain.get("cpu_minutes", each.plain["minutes"]) for each in found)
        options = f"`{command.removeprefix(PROGRAM).strip()}`"
        rows.append([commit, day, number(minutes), options, " ".join(map(name_of, found))])
    header = ("commit", "date", "core minutes", "options", "rows")
    processors = ", ".join(sorted({str(each.plain["provenance"]["cpu"]) for each in results}))
    notes = (
        f"options: of `{PROGRAM}`; processor: {processors}; changed: with files that were not "
        "committed",
    )
    return Table("Measured at", header, rows, notes)


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
    if not compared:
        return []
    header = ("scene", "views", "of", "default", "method", "accuracy", "difference")
    notes = (
        f"accuracy at 15 m in %; the default is as good or better in {compared - len(rows)} of "
        f"{compared} comparisons",
        "within the noise: less than two standard errors of the difference",
    )
    return [Table("Rows above orthonav's default", header, rows, notes)]
