"""Tables 2 and 3 and further tables from result files alone, and `docs/paper-results.md`."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.record import Table, number
from benchmarks.scenes import far_m
from numpy.typing import NDArray

from experiments.paper import curves
from experiments.paper.methods import (
    BETWEEN_DATES,
    CANNY,
    DEFAULT,
    GREY,
    LEARNT,
    SETTINGS,
    SWEPT_ON,
    TABLE_1,
    Method,
    column,
)
from experiments.paper.published import (
    LOWE,
    TRAJECTORIES,
    published_accuracy,
    published_criterion,
    stands_for,
)
from experiments.paper.results import (
    ACCURACY_M,
    DATES,
    FIELD,
    TUNED,
    WORDS,
    Result,
    Row,
    accepted_at,
    best_words,
    by_scene,
    ceiling,
    confident,
    is_tuned,
    label,
    name_of,
    named,
    numbers,
    percent,
    read,
    row_label,
    row_of,
    share,
)
from experiments.paper.scenes import PLACEMENTS
from orthonav.core.records import CONFIDENT

PROGRAM = "python -m experiments.paper"
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
    made = [each for each in results if each.family]
    return [
        *scenes(made),
        *accuracy(made),
        *dates(made),
        *criterion(made),
        *accepted(made),
        *above_default(made),
        *rules(made),
        *sensitivity(made),
        *baselines(results, made),
        *field(results),
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
        *("upper bound %", "views"),
    )
    notes = (
        "upper bound: accuracy at 15 m, anywhere, of a method that always finds the correct tile; "
        "views: along the route (one per tile step), on the grid of tiles, anywhere",
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


COMPARED = (
    ("autoencoder", CANNY),
    ("autoencoder", GREY),
    ("autoencoder", LEARNT),
    ("bovw", GREY),
    (DEFAULT, DEFAULT),
)
"""Columns of `dates`: family and input."""


def dates(results: Sequence[Result]) -> list[Table]:
    """Canny edges and grey levels of each scene with standard errors, and their difference."""
    found = {scene: _compared(rows) for scene, rows in by_scene(results)}
    found = {scene: rows for scene, rows in found.items() if COMPARED[0] in rows}
    real = [scene for scene in found if column(scene) not in TABLE_1]
    if not real:
        return []
    drawn = [scene for scene in found if scene not in real]
    both = [found[scene] for scene in real if COMPARED[1] in found[scene]]
    differences = [difference(*(rows[each] for each in COMPARED[:2])) for rows in both]
    rows = [_dates_row(scene, found[scene]) for scene in (*drawn, *real)]
    means = []
    for each in COMPARED:
        shares = [found[scene][each].accuracy("grid") for scene in real if each in found[scene]]
        means.append(_of_scenes(shares, len(real)))
    of_both = _of_scenes([mean for mean, _ in differences], len(real), signed=True)
    empty = ["", "", "", ""]
    rows.append(["mean of the real scenes", "", "", *means[:2], of_both, *means[2:], *empty])
    signs = [0 if abs(mean) <= 2 * error else math.copysign(1, mean) for mean, error in differences]
    counted = " / ".join(str(signs.count(sign)) for sign in (1, -1, 0))
    counts = ["Canny better / worse / equal", "", "", "", "", counted, "", "", ""]
    rows.append([*counts, *empty])
    labels = [row_label(Row((0, False, 0), *each, False)) for each in COMPARED]
    header = (
        *("scene", "dates", "m per pixel", *labels[:2], "Canny minus grey", *labels[2:]),
        *("default, anywhere", "alike: grey", "alike: Canny", "SIFT found again"),
    )
    notes = (
        "accuracy at 15 m in %, with its standard error over the views; views on the grid: where "
        "tiles lie more than 15 m apart this is the share of correct tiles; default, anywhere: "
        "orthonav's default, views between the tiles",
        "Canny minus grey: of the same views; the mean is over scenes, with the standard error "
        "over scenes; better, worse: scenes with a difference of more than two standard errors",
        f"alike: correlation of a view and its tile, of grey levels and of Canny edges smoothed by "
        "a Gaussian of 1 px; SIFT found again: features of a view whose most similar feature of "
        f"the correct tile is within 3 px, in %; means over the views, `{PROGRAM} pictures`",
    )
    return [Table("Canny or grey between dates", header, rows, notes)]


def _compared(rows: Sequence[Result]) -> dict[tuple[str, str], Result]:
    """Results of a scene by family and input; orthonav's default as "default"."""
    placed = {(each.family, each.edges): each for each in best_words(rows) if not each.registration}
    ours = [each for each in rows if each.registration]
    return placed | ({("default", ""): ours[0]} if ours else {})


def difference(canny: Result, grey: Result) -> tuple[float, float]:
    """Mean difference of two results over the same views on the grid, and its standard error."""
    pairs = zip(canny.right("grid"), grey.right("grid"), strict=True)
    return mean_and_error([float(one) - float(other) for one, other in pairs])


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error; NaN of fewer than two values."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return (float(np.mean(values)) if values else math.nan), spread / math.sqrt(len(values) or 1)


def _dates_row(scene: str, rows: dict[tuple[str, str], Result]) -> list[str]:
    plain = rows[COMPARED[0]].plain
    stems = [Path(name).stem for name in list(plain.get("inputs", {}))[:2]]
    shown = " / ".join(stem.removeprefix(f"{scene.replace('-', '_')}_") for stem in stems)
    cells = []
    for each in COMPARED:
        star = "*" if each in rows and is_tuned(rows[each]) else ""
        cells.append(_accuracy(rows[each]) + star if each in rows else "-")
    apart = "-"
    if COMPARED[1] in rows:
        apart = _plus_minus(*difference(*(rows[each] for each in COMPARED[:2])), signed=True)
    ours = rows.get(("default", ""))
    alike = _alike().get(scene)
    seen = [f"{alike['grey']:.2f}", f"{alike['canny']:.2f}"] if alike else ["-", "-"]
    seen.append(percent(alike["features"]) if alike else "-")
    default = "-" if ours is None else _accuracy(ours, "anywhere")
    start = [scene, shown or "-", f"{plain['trajectory']['gsd_m']:g}"]
    return [*start, *cells[:2], apart, *cells[2:], default, *seen]


def _accuracy(each: Result, placement: str = "grid") -> str:
    return _share(int(each.right(placement).sum()), len(each.right(placement)))


def _share(right: int, count: int) -> str:
    """A share in per cent with its standard error."""
    if not count:
        return "-"
    mean = right / count
    return _plus_minus(mean, math.sqrt(mean * (1 - mean) / count))


def _plus_minus(mean: float, error: float, *, signed: bool = False) -> str:
    if math.isnan(mean):
        return "-"
    shown = f"{100 * mean:+.0f}" if signed else percent(mean)
    return f"{shown} ± {percent(error)}"


def _of_scenes(values: Sequence[float], scenes: int, *, signed: bool = False) -> str:
    """Mean and standard error over scenes, with their number where some are missing."""
    shown = _plus_minus(*mean_and_error(values), signed=signed)
    return shown if len(values) == scenes else f"{shown} ({len(values)} of {scenes})"


def _alike() -> dict[str, dict[str, Any]]:
    """What `pictures` has measured, by scene."""
    if not DATES.is_file():
        return {}
    found = json.loads(DATES.read_text(encoding="utf-8"))
    return {each["scene"]: each for each in found["scenes"]}


def criterion(results: Sequence[Result]) -> list[Table]:
    """Table 3: accuracy of the views that the confidence criterion accepts."""

    def cell(each: Result) -> str:
        name, threshold = ("confidence", CONFIDENT) if each.registration else ("lowe_ratio", LOWE)
        return _joined(confident(each.right("grid"), each.column("grid", name), threshold))

    notes = (
        "accuracy at 15 m of the accepted views / fraction accepted; views on the grid, whose "
        "accuracy without the criterion is in Table 2",
        f"criterion: Lowe's ratio of {LOWE}; orthonav, default: confidence {CONFIDENT:g}",
    )
    found = [each for each in results if each.family != "bovw"]
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
        if each.scene in TRAJECTORIES and each.family != "bovw" and not each.registration
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
        found = [(s, f) for s, f in by_scene(results) if (s in TRAJECTORIES) == papers]
        if found:
            names = [scene for scene, _ in found]
            rows = _rows(found, cell, paper if papers else None)
            if chance:
                rows.append(["random tile", *(chance(each[0]) for _, each in found)])
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
            known = " (Segment Anything)" if stands_for(row.edges) != row.edges else ""
            rows.append([f"- in the paper{known}", *figures])
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
    for step, title in STEPS:
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
            notes = (
                f"{count} views on the grid of {swept[0].scene}; the default searches headings, "
                "the other methods take the reported one as exact",
            )
            header = ("method", *values)
            made.append(Table(f"Figure 3: accuracy at 15 m, %, by {title}", header, rows, notes))
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


def above_default(results: Sequence[Result]) -> list[Table]:
    """Every row that locates more views within 15 m than orthonav's default on its scene."""
    rows, compared = [], 0
    for scene, found in by_scene(results):
        for ours in (each for each in found if each.registration):
            for each in (other for other in best_words(found) if not other.registration):
                compared += len(PLACEMENTS)
                rows += [
                    _above_row(scene, name, ours, each)
                    for name in PLACEMENTS
                    if each.accuracy(name) > ours.accuracy(name)
                ]
    if not compared:
        return []
    header = ("scene", "views", "of", "default", "method", "accuracy", "difference")
    notes = (
        f"accuracy at 15 m in %; the default is as good or better in {compared - len(rows)} of "
        f"{compared} comparisons",
        "within the noise: less than two standard errors of the difference",
    )
    return [Table("Rows above orthonav's default", header, rows, notes)]


def _above_row(scene: str, name: str, ours: Result, each: Result) -> list[str]:
    shares = [ours.accuracy(name), each.accuracy(name)]
    count = len(each.plain["views"][name])
    spread = math.sqrt(sum(p * (1 - p) for p in shares) / count)
    size = "within the noise" if shares[1] - shares[0] <= 2 * spread else "significant"
    return [
        *(scene, name, str(count), percent(shares[0])),
        *(named(each), percent(shares[1]), size),
    ]


@dataclass(frozen=True, eq=False)
class Placed:
    """What a method made of the views of one or several scenes.

    - `error_m` (N,): infinite without an answer. `far_m` (N,): error above which it is wrong.
    - `evidence` (N,): -inf without an answer. `mirrored` (M,): that of mirrored views.
    """

    error_m: NDArray[np.float64]
    far_m: NDArray[np.float64]
    evidence: NDArray[np.float64]
    mirrored: NDArray[np.float64]

    @classmethod
    def of(cls, rows: Sequence[Result], name: str) -> "Placed":
        parts = [each.plain[FIELD][name] for each in rows if name in each.plain[FIELD]]
        shapes = [each.plain["trajectory"] for each in rows if name in each.plain[FIELD]]
        views = [row for part in parts for row in part["views"]]
        far = [
            far_m(shape["gsd_m"])
            for part, shape in zip(parts, shapes, strict=True)
            for _ in part["views"]
        ]
        return cls(
            numbers([error for error, _ in views], math.inf),
            np.array(far),
            numbers([evidence for _, evidence in views], -math.inf),
            numbers([each for part in parts for each in part["mirrored"]], -math.inf),
        )

    @property
    def right(self) -> NDArray[np.bool_]:
        """Mask (N,) of the views that are not wrong."""
        return self.error_m <= self.far_m

    def within(self, radius_m: float = ACCURACY_M) -> float:
        return float((self.error_m <= radius_m).mean())

    def trusted(self) -> float:
        """Largest share of the right views that a threshold accepts with no wrong one."""
        wrong = np.concatenate([self.evidence[~self.right], self.mirrored, [-math.inf]])
        right = self.evidence[self.right]
        return float((right > wrong.max()).mean()) if right.size else math.nan

    def accepted(self, threshold: float) -> tuple[float, int]:
        """Share of the right views that a threshold accepts, and how many wrong ones."""
        accepted = self.evidence >= threshold
        right = float(accepted[self.right].mean()) if self.right.any() else math.nan
        return right, int((accepted & ~self.right).sum() + (self.mirrored >= threshold).sum())

    def median_m(self) -> float:
        """Median error of the right views."""
        return float(np.median(self.error_m[self.right])) if self.right.any() else math.nan


def field(results: Sequence[Result]) -> list[Table]:
    """Each method over all scenes, and scene by scene."""
    rows = [each for each in results if FIELD in each.plain]
    if not rows:
        return []
    names = list(dict.fromkeys(name for each in rows for name in each.plain[FIELD]))
    flown = [Method(**plain) for each in rows for plain in each.plain["methods"]]
    shown = {each.key: label(each) for each in flown}
    return [_summary(rows, names, shown), _field_by_scene(rows, names, shown)]


def _summary(rows: Sequence[Result], names: Sequence[str], shown: dict[str, str]) -> Table:
    lines = []
    for name in names:
        placed = Placed.of(rows, name)
        parts = [each.plain[FIELD][name] for each in rows if name in each.plain[FIELD]]
        own = placed.accepted(CONFIDENT) if name.endswith("registration") else None
        lines.append(
            [
                shown.get(name, name),
                percent(placed.within()),
                percent(float(placed.right.mean())),
                percent(placed.trusted()),
                "-" if own is None else f"{percent(own[0])} / {own[1]}",
                number(placed.median_m()),
                number(max(part["cpu_s"] for part in parts)),
                number(max(part["peak_mb"] for part in parts)),
                number(sum(part["carried_mb"] for part in parts)),
            ]
        )
    errors = rows[0].plain["errors"]
    counts = Placed.of(rows, names[0])
    header = (
        *("method", "15 m", "35 m or 10 px", "accepted at no wrong"),
        *("accepted / wrong", "median m", "CPU s per view", "peak MB", "carried MB"),
    )
    notes = (
        f"scenes: {', '.join(each.scene for each in rows)}; "
        f"{len(counts.error_m)} views anywhere, of the later date, and {len(counts.mirrored)} "
        "mirrored; "
        f"standard deviations of the reported heading, {errors['yaw_std_deg']:g} deg, the height, "
        f"{errors['agl_std']:.0%}, and the prior, {errors['prior_std_px']:g} px: the same for all",
        "views in %; accepted at no wrong: of those correct within 35 m or 10 px, the "
        "largest fraction that one threshold over all scenes accepts without a wrong one; every "
        "answer to a mirrored view is wrong; evidence: inliers, Lowe's ratio, or the confidence",
        f"accepted / wrong: of the correct ones, and number of wrong ones, at a confidence of "
        f"{CONFIDENT:g}, where a method states one",
        "CPU s, peak MB: the largest of the scenes' medians and peaks, one core; carried: "
        "keypoints (descriptors in 16 bits) or maps with their encoders, all scenes",
    )
    return Table("The field today: all scenes", header, lines, notes)


def _field_by_scene(rows: Sequence[Result], names: Sequence[str], shown: dict[str, str]) -> Table:
    lines = []
    for name in names:
        cells = [shown.get(name, name)]
        for each in rows:
            placed = Placed.of([each], name) if name in each.plain[FIELD] else None
            far = None if placed is None else float(placed.right.mean())
            cells.append("-" if placed is None else f"{percent(placed.within())}/{percent(far)}")
        lines.append(cells)
    guess = ["the prior itself"]
    for each in rows:
        away = np.array(next(iter(each.plain[FIELD].values()))["prior_m"])
        radii = ACCURACY_M, far_m(each.plain["trajectory"]["gsd_m"])
        shares = (float((away <= radius).mean()) for radius in radii)
        guess.append("/".join(map(percent, shares)))
    header = ("method", *(each.scene for each in rows))
    notes = ("fraction of the views within 15 m / within 35 m or 10 px, in %",)
    return Table("The field today, scene by scene", header, [*lines, guess], notes)


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
    text += [agreement().markdown(), words().markdown()]
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


def words() -> Table:
    """The bag of words by vocabulary and similarity, on views of the map's date and of another."""
    found = json.loads(WORDS.read_text(encoding="utf-8"))["scenes"]
    rows = [
        [
            *(each["scene"], f"{row['words']:,}", f"{row['features']:,}"),
            row["similarity"] + (", tf-idf" if row["tfidf"] else ""),
            *(_share(*row[date]["right"]) for date in ("same", "other")),
            *(number(100 * row[date]["above"]) for date in ("same", "other")),
        ]
        for each in found
        for row in each["rows"]
    ]
    again = [
        f"{each['scene']} "
        + " / ".join(number(100 * each["found_again"][n]) for n in ("same", "other", "elsewhere"))
        for each in found
    ]
    about = found[0]["provenance"]
    notes = (
        "views on the grid: accuracy at 15 m in % with its standard error; features: most SIFT "
        "features of a picture; tiles above: median share of the tiles with a higher score than "
        "the correct one, in %, 50 for a guess",
        "SIFT features of a view whose most similar feature of the tile is within 3 px, in %, same "
        f"date / other date / another tile: {'; '.join(again)}",
        f"made by `{found[0]['command']}` at {about['commit'][:10]}, {about['date'][:10]}",
    )
    header = (
        *("scene", "words", "features", "similarity", "same date", "other date"),
        *("tiles above, same", "tiles above, other"),
    )
    return Table("Bag of words between dates", header, rows, notes)
