"""Tables 2 and 3 and further tables, from result files alone."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.record import Table, number

from experiments.paper import published
from experiments.paper.comparison import above_default, orders
from experiments.paper.field_tables import field
from experiments.paper.labels import EDGES, TUNED, best_words, by_scene, is_tuned, label, named
from experiments.paper.methods import column
from experiments.paper.results import Result, accepted_at, ceiling, confident, percent, read, share
from experiments.paper.stored import name_of
from experiments.paper.views import PLACEMENTS
from orthonav.core.records import CONFIDENT


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
        *table_2(made),
        *orders(made),
        *above_default(made),
        *table_3(made),
        *choice(made),
        *rules(made),
        *sensitivity(made),
        *resolutions(made),
        *baselines(results, made),
        *field(results, label),
        *costs(made),
        row_table(results),
    ]


def table_2(results: Sequence[Result]) -> list[Table]:
    """Accuracy at 15 m by method and scene, views on the grid and anywhere."""
    header = ("method", "input", "paper", "route", "on grid", "anywhere", "right tile", "of")
    made = []
    for scene, found in by_scene(results):
        rows = [_table_2_row(each) for each in best_words(found)]
        chance = found[0].plain["chance"]
        guessed = (percent(chance.get(name)) for name in PLACEMENTS)
        rows.append(["a guess", "", "-", *guessed, "", ""])
        made.append(Table(f"Table 2, {scene}: accuracy at 15 m, %", header, rows, _area(found)))
    return made


def _table_2_row(each: Result) -> list[str]:
    placed = [*(each.accuracy(name) for name in PLACEMENTS), each.right_tile("anywhere")]
    views = " / ".join(str(len(each.plain["views"][name])) for name in PLACEMENTS)
    paper = (
        "-"
        if each.registration
        else published.accuracy(each.family, each.edges, column(each.scene))
    )
    return [named(each), EDGES[each.edges], paper, *map(percent, placed), views]


def _area(found: Sequence[Result]) -> list[str]:
    flown, first = found[0].plain["trajectory"], found[0]
    tiles = first.plain["tiles"]
    bound = ceiling(first.stride_m)
    return [
        f"{flown['length_m']:g} x {flown['band_m']:g} m from {flown['agl_m']:g} m, "
        f"{flown['gsd_m']:g} m per pixel, {tiles:,} tiles {first.stride_m:g} m apart; a method "
        f"that always finds the correct tile has {percent(bound)} % at 15 m anywhere",
        "route: one view per tile step along the route; right tile: share of the views anywhere "
        "that are within half a tile spacing (along the diagonal); of: number of views of each "
        "kind",
        TUNED,
    ]


def table_3(results: Sequence[Result]) -> list[Table]:
    """The confidence criterion and the ratio with an exclusion radius; views on the grid."""
    header = (
        *("scene", "method", "input", "paper acc. / accepted", "Lowe 1.13: acc. / accepted"),
        *(
            "Lowe: accepted at 95 %",
            "excluding: accepted at 95 %",
            "median Lowe",
            "median excluding",
        ),
    )
    rows = []
    for scene, found in by_scene(results):
        for each in best_words(found):
            if each.registration or each.family == "bovw":
                continue
            rows.append(_table_3_row(scene, each))
    if not rows:
        return []
    notes = (
        "accuracy at 15 m of the accepted views, and their share, in %, views on the grid",
        "accepted at 95 %: largest share that a threshold accepts with at least 95 % correct, "
        "chosen on the same views; excluding: best score over the best one beyond half a tile",
    )
    return [Table("Table 3: confidence criteria", header, rows, notes)]


def _table_3_row(scene: str, each: Result) -> list[str]:
    right = each.right("grid")
    lowe, peak = (each.column("grid", name) for name in ("lowe_ratio", "peak_ratio"))
    found, accepted = confident(right, lowe, published.LOWE)
    paper = published.confident(each.edges, scene) if each.family == "autoencoder" else "-"
    cells = [percent(accepted_at(right, ratio)) for ratio in (lowe, peak)]
    medians = [f"{_median(ratio):.3f}" for ratio in (lowe, peak)]
    both = f"{percent(found)} / {percent(accepted)}"
    return [scene, named(each), EDGES[each.edges], paper, both, *cells, *medians]


def choice(results: Sequence[Result]) -> list[Table]:
    """The paper's best method and orthonav over other imagery."""
    rows = []
    for scene, found in by_scene(results):
        shown = [e for e in found if e.family == "gradient" or _is_papers_best(e)]
        if column(scene) not in published.TRAJECTORIES and len(shown) > 1:
            rows += [_choice_row(scene, each) for each in shown]
    if not rows:
        return []
    header = (
        *("scene", "method", "input", "on grid", "anywhere", "right tile", "criterion"),
        *("correct / accepted", "learn s", "MB per km2", "encoder MB", "ms per view"),
    )
    notes = (
        "accuracy at 15 m in %; right tile: of views anywhere; correct / accepted: of views on "
        "the grid, by the criterion; ms: one view, one core, from its picture to the fix",
        TUNED,
    )
    return [Table("The paper's best and orthonav on other imagery", header, rows, notes)]


def _is_papers_best(each: Result) -> bool:
    return each.family == "autoencoder" and each.edges == "canny"


def _choice_row(scene: str, each: Result) -> list[str]:
    plain, right = each.plain, each.right("grid")
    name, threshold = (
        ("confidence", CONFIDENT) if each.registration else ("lowe_ratio", published.LOWE)
    )
    found, accepted = confident(right, each.column("grid", name), threshold)
    shares = [each.accuracy("grid"), each.accuracy("anywhere"), each.right_tile("anywhere")]
    criterion = f"confidence {CONFIDENT}" if each.registration else f"Lowe {published.LOWE}"
    figures = [plain["learn_s"], plain["mb_per_km2"], plain["encoder_mb"], plain["view_ms"]]
    both = f"{percent(found)} / {percent(accepted)}"
    cells = [named(each), EDGES[each.edges], *map(percent, shares), criterion, both]
    return [scene, *cells, *map(number, figures)]


def rules(results: Sequence[Result]) -> list[Table]:
    """Rules of position and similarities on one trajectory."""
    found = [each for each in results if each.plain.get("rules") and each.scene == "B"]
    if not found:
        return []
    names = list(found[0].plain["rules"]["grid"])
    rows = []
    for each in best_words(found):
        for placement in ("grid", "anywhere"):
            shares = [share(each.plain["rules"][placement][name]) for name in names]
            rows.append([f"{named(each)}, {EDGES[each.edges]}", placement, *map(percent, shares)])
    notes = (
        "product: embeddings without scaling; cosine: the same, scaled to length 1. best: the "
        "paper; weighted: all tiles by score (Bianchi and Barfoot); neighbours: after Couturier "
        "and Akhloufi; peak: orthonav's",
    )
    header = ("method", "views", *names)
    return [Table("Rules of position, B: accuracy at 15 m, %", header, rows, notes)]


def baselines(results: Sequence[Result], made: Sequence[Result]) -> list[Table]:
    """Methods that carry the reference images, and orthonav on the same trajectory."""
    rows = []
    for each in results:
        for name, result in each.plain.get("baselines", {}).items():
            shares = [share(result["views"][placement]) for placement in ("grid", "anywhere")]
            count = result["views"]["anywhere"][1]
            rows.append(
                [each.scene, name, *map(percent, shares), str(count), number(result["view_ms"])]
            )
    if not rows:
        return []
    scenes = {row[0] for row in rows}
    for each in made:
        if each.family == "gradient" and each.scene in scenes:
            shares = [each.accuracy(placement) for placement in ("grid", "anywhere")]
            count = len(each.plain["views"]["anywhere"])
            ms = number(each.plain["view_ms"])
            rows.append([each.scene, named(each), *map(percent, shares), str(count), ms])
    header = ("scene", "method", "on grid", "anywhere", "of", "ms per view")
    notes = ("the baselines carry the orthophoto itself; reported pose, whole map, no prior",)
    return [Table("Related work: accuracy at 15 m, %", header, rows, notes)]


def costs(results: Sequence[Result]) -> list[Table]:
    """What each method takes: time to learn, size of the map, time of a view."""
    rows = []
    for scene, found in by_scene(results):
        for each in found:
            plain = each.plain
            figures = [plain["learn_s"], plain["mb_per_km2"], plain["encoder_mb"], plain["view_ms"]]
            recipe = plain["method"]["recipe"]
            name = f"{recipe}, with registration" if each.registration else recipe
            rows.append([scene, name, EDGES[each.edges], *map(number, figures)])
    header = ("scene", "method", "input", "learn s", "MB per km2", "encoder MB", "ms per view")
    notes = (
        "learn s: the encoder, with embedding all tiles; MB per km2: the map file less the encoder "
        "or vocabulary, which it holds once; ms: one view from its picture to the fix",
    )
    return [Table("What it costs", header, rows, notes)]


def sensitivity(results: Sequence[Result]) -> list[Table]:
    """Accuracy at each error of heading and height, on the trajectory that the paper sweeps."""
    made = []
    for step, title in (("heading_deg", "heading error, deg"), ("drop_m", "height lower by, m")):
        swept = [each for each in best_words(results) if each.plain.get("sweep")]
        if swept:
            values = list(swept[0].plain["sweep"][step])
            count = swept[0].plain["sweep"][step][values[0]][1]
            rows = [
                [
                    f"{named(each)}, {EDGES[each.edges]}",
                    *(percent(share(each.plain["sweep"][step][value])) for value in values),
                ]
                for each in swept
            ]
            notes = (f"{count} views on the grid of {swept[0].scene}",)
            header = ("method", *values)
            made.append(Table(f"Accuracy at 15 m, %, by {title}", header, rows, notes))
    return made


def resolutions(results: Sequence[Result]) -> list[Table]:
    """Accuracy anywhere by ground resolution, where a trajectory was run at several."""
    rows = []
    for scene in sorted({each.scene for each in results if column(each.scene) != each.scene}):
        if column(scene) not in published.TRAJECTORIES:
            continue
        for each in best_words([e for e in results if e.scene in (scene, column(scene))]):
            shares = [ceiling(each.stride_m), each.accuracy("anywhere")]
            gsd_m = f"{each.plain['trajectory']['gsd_m']:g}"
            cells = [named(each), EDGES[each.edges], gsd_m, f"{each.stride_m:g}"]
            rows.append([column(scene), *cells, *map(percent, shares)])
    header = ("trajectory", "method", "input", "m per pixel", "tile step m", "possible", "anywhere")
    return [Table("Accuracy anywhere by ground resolution, %", header, rows)] if rows else []


def row_table(results: Sequence[Result]) -> Table:
    """Commit, day, minutes and machine of every row."""
    rows = []
    for each in sorted(results, key=name_of):
        made = each.plain["provenance"]
        changed = "yes" if made["dirty"] else "no"
        about = [str(made["commit"])[:10], changed, str(made["date"])[:10]]
        mark = "yes" if each.family and is_tuned(each) else "no"
        times = [each.plain.get("cpu_minutes"), each.plain["minutes"]]
        cost = [*("-" if minutes is None else number(minutes) for minutes in times), made["cpu"]]
        rows.append([name_of(each), mark, *about, *cost])
    header = (
        *("row", "tuned on it", "commit", "files not committed", "date"),
        *("core minutes", "minutes", "processor"),
    )
    known = [each.plain["cpu_minutes"] for each in results if "cpu_minutes" in each.plain]
    notes = (
        f"core minutes: processor time, {sum(known):.0f} for {len(known)} rows together; minutes: "
        "elapsed time, longer beside other work",
    )
    return Table("Rows", header, rows, notes)


def _median(values: Iterable[float]) -> float:
    known = sorted(value for value in values if math.isfinite(value))
    return known[len(known) // 2] if known else math.nan
