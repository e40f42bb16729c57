"""Tables 2 and 3 and further tables, from result files alone."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from benchmarks.record import Table, number

from experiments.paper import published
from experiments.paper.comparison import above_default
from experiments.paper.field_tables import field
from experiments.paper.labels import (
    TUNED,
    Row,
    best_words,
    by_scene,
    is_tuned,
    label,
    named,
    row_label,
    row_of,
)
from experiments.paper.results import (
    Result,
    accepted_at,
    ceiling,
    confident,
    name_of,
    percent,
    read,
    share,
)
from experiments.paper.runs import SWEPT_ON
from experiments.paper.views import PLACEMENTS
from orthonav.core.records import CONFIDENT

PROGRAM = "python -m experiments.paper"
SHOWN_RULES = ("product best", "product weighted", "cosine best", "cosine neighbours")
Cell = Callable[[Result], str]
Published = Callable[[str, str, str], str]
"""The paper's figure of a family, an input and a scene."""


def report(out: Path, setting: str) -> Path | None:
    """Write `tables.md` and the plots next to the result files; None without results."""
    folder = out / setting
    results = read(folder)
    if not results:
        return None
    made = [r for r in results if r.family]
    try:
        from experiments.paper.plots import draw
    except ImportError:
        notes = ["Plots need matplotlib: pip install 'orthonav[report]'"]
    else:
        notes = [f"![{path.stem}]({path.name})" for path in draw(made, folder)]
    text = "\n".join([*(table.markdown() for table in tables(results)), *notes, ""])
    path = folder / "tables.md"
    path.write_text(text, encoding="utf-8")
    return path


def tables(results: Sequence[Result]) -> list[Table]:
    """All tables of results of one setting."""
    made = [each for each in results if each.family]
    return [
        *scenes(made),
        *accuracy(made),
        *criterion(made),
        *accepted(made),
        *above_default(made),
        *rules(made),
        *sensitivity(made),
        *baselines(results, made),
        *field(results, label),
        *costs(made),
        provenance(results),
    ]


def scenes(results: Sequence[Result]) -> list[Table]:
    """Size, resolution and numbers of views of each scene."""
    rows = []
    for scene, found in by_scene(results):
        first = found[0]
        flown = first.plain["trajectory"]
        views = "/".join(str(len(first.plain["views"][name])) for name in PLACEMENTS)
        size = [f"{flown['length_m']:g} x {flown['band_m']:g}", f"{flown['agl_m']:g}"]
        grid = [f"{flown['gsd_m']:g}", f"{first.plain['tiles']:,}", f"{first.stride_m:g}"]
        rows.append([scene, *size, *grid, percent(ceiling(first.stride_m)), views])
    header = (
        *("scene", "area m", "height m", "m per pixel", "tiles", "tile step m"),
        *("possible %", "views"),
    )
    notes = (
        "possible: accuracy at 15 m, anywhere, of a method that always finds the correct tile; "
        "views: along the route (one per tile step), on the grid of tiles, anywhere",
    )
    return [Table("Scenes", header, rows, notes)] if rows else []


def accuracy(results: Sequence[Result]) -> list[Table]:
    """Table 2: accuracy at 15 m by method and scene, for the three kinds of views."""

    def cell(each: Result) -> str:
        return _joined(each.accuracy(name) for name in PLACEMENTS)

    def chance(each: Result) -> str:
        return _joined(each.plain["chance"].get(name, math.nan) for name in PLACEMENTS)

    notes = ("views along the route / on the grid / anywhere", TUNED)
    title = "Table 2: accuracy at 15 m, %"
    return _by_scene(title, results, cell, notes, published.accuracy, chance)


def criterion(results: Sequence[Result]) -> list[Table]:
    """Table 3: accuracy of the views that the confidence criterion accepts."""

    def cell(each: Result) -> str:
        name, threshold = (
            ("confidence", CONFIDENT) if each.registration else ("lowe_ratio", published.LOWE)
        )
        return _joined(confident(each.right("grid"), each.column("grid", name), threshold))

    notes = (
        "accuracy at 15 m of the accepted views / fraction accepted; views on the grid, whose "
        "accuracy without the criterion is in Table 2",
        f"criterion: Lowe's ratio of {published.LOWE}; orthonav, default: confidence {CONFIDENT:g}",
    )
    found = [each for each in results if each.family != "bovw"]
    return _by_scene("Table 3: with the criterion, %", found, cell, notes, published.criterion)


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
        if each.scene in published.TRAJECTORIES and each.family != "bovw" and not each.registration
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
        found = [(s, f) for s, f in by_scene(results) if (s in published.TRAJECTORIES) == papers]
        if found:
            names = [scene for scene, _ in found]
            rows = _rows(found, cell, paper if papers else None)
            if chance:
                rows.append(["a guess", *(chance(each[0]) for _, each in found)])
            header = ("method", *names)
            made.append(Table(f"{title}: {what}", header, rows, () if made else notes))
    return made


def _rows(
    found: Sequence[tuple[str, list[Result]]], cell: Cell, paper: Published | None
) -> list[list[str]]:
    """A row of cells for each method, and below it the paper's figures."""
    cells: dict[Row, dict[str, str]] = {}
    for scene, results in found:
        for each in best_words(results):
            star = "*" if is_tuned(each) else ""
            cells.setdefault(row_of(each), {})[scene] = cell(each) + star
    rows = []
    for row in sorted(cells):
        rows.append([row_label(row), *(cells[row].get(scene, "-") for scene, _ in found)])
        figures = [paper(row.family, row.edges, scene) for scene, _ in found] if paper else []
        if not row.registration and any(each != "-" for each in figures):
            rows.append(["- in the paper", *figures])
    return rows


def _joined(fractions: Iterable[float]) -> str:
    return "/".join(map(percent, fractions))


def rules(results: Sequence[Result]) -> list[Table]:
    """Rules of position and similarities on one trajectory."""
    found = [each for each in results if each.plain.get("rules") and each.scene == SWEPT_ON]
    if not found:
        return []
    rows = []
    for each in best_words(found):
        placed = [each.plain["rules"][placement] for placement in ("grid", "anywhere")]
        cells = (_joined(share(part[name]) for part in placed) for name in SHOWN_RULES)
        rows.append([named(each), *cells])
    notes = (
        "views on the grid / anywhere",
        "product: embeddings without scaling; cosine: the same, scaled to length 1; best: the "
        "paper; weighted: all tiles by score (Bianchi and Barfoot); neighbours: after Couturier "
        "and Akhloufi",
    )
    header = ("method", *SHOWN_RULES)
    return [Table(f"Rules of position, {SWEPT_ON}: accuracy at 15 m, %", header, rows, notes)]


def sensitivity(results: Sequence[Result]) -> list[Table]:
    """Accuracy at each error of heading and height, on the trajectory that the paper sweeps."""
    made: list[Table] = []
    for step, title in (("heading_deg", "heading error, deg"), ("drop_m", "height lower by, m")):
        swept = [each for each in best_words(results) if each.plain.get("sweep")]
        if swept:
            values = list(swept[0].plain["sweep"][step])
            count = swept[0].plain["sweep"][step][values[0]][1]
            rows = [
                [
                    named(each),
                    *(percent(share(each.plain["sweep"][step][value])) for value in values),
                ]
                for each in swept
            ]
            notes = (f"{count} views on the grid of {swept[0].scene}",)
            header = ("method", *values)
            made.append(Table(f"Accuracy at 15 m, %, by {title}", header, rows, notes))
    return made


def baselines(results: Sequence[Result], made: Sequence[Result]) -> list[Table]:
    """Methods that carry the reference images, and orthonav on the same trajectory."""
    found = []
    for tried in (each for each in results if "baselines" in each.plain):
        rows = []
        for name, result in tried.plain["baselines"].items():
            fractions = [share(result["views"][placement]) for placement in ("grid", "anywhere")]
            count = result["views"]["anywhere"][1]
            rows.append([name, *map(percent, fractions), str(count), number(result["view_ms"])])
        for each in made:
            if each.family == "gradient" and each.scene == tried.scene:
                fractions = [each.accuracy(placement) for placement in ("grid", "anywhere")]
                count = len(each.plain["views"]["anywhere"])
                ms = number(each.plain["view_ms"])
                rows.append([named(each), *map(percent, fractions), str(count), ms])
        header = ("method", "on grid", "anywhere", "of", "ms per view")
        notes = ("the baselines carry the orthophoto itself; reported pose, whole map, no prior",)
        title = f"Related work, {tried.scene}: accuracy at 15 m, %"
        found.append(Table(title, header, rows, notes))
    return found


def costs(results: Sequence[Result]) -> list[Table]:
    """Time to learn, size of the map, time of a view, on one scene."""
    found = dict(by_scene(results))
    if not found:
        return []
    scene = SWEPT_ON if SWEPT_ON in found else next(iter(found))
    rows = []
    for each in best_words(found[scene]):
        plain = each.plain
        figures = [plain["learn_s"], plain["mb_per_km2"], plain["encoder_mb"], plain["view_ms"]]
        rows.append([named(each), *map(number, figures)])
    header = ("method", "learn s", "MB per km2", "encoder MB", "ms per view")
    notes = (
        "learn s: the encoder, with embedding all tiles; MB per km2: the map file less the encoder "
        "or vocabulary, which it holds once; ms: one view from its picture to the fix, one core",
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
        names = " ".join(map(name_of, found))
        rows.append(
            [commit, day, number(minutes), f"`{command.removeprefix(PROGRAM).strip()}`", names]
        )
    header = ("commit", "date", "core minutes", "options", "rows")
    processors = ", ".join(sorted({str(each.plain["provenance"]["cpu"]) for each in results}))
    notes = (
        f"options: of `{PROGRAM}`; processor: {processors}; changed: with files that were not "
        "committed",
    )
    return Table("Measured at", header, rows, notes)
