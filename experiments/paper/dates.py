"""How alike two dates look to each method, and pictures of what the encoder sees of them.

`python -m experiments.paper pictures` writes `dates.json`, which `keep` stores, and pictures: a
tile of the map and the view of the same place, as grey levels and as Canny edges. Those of real
imagery stay where they are written: the imagery is not ours.
"""

import json
import time
from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from benchmarks.record import Table, provenance
from numpy.typing import NDArray

from experiments.paper import scenes
from experiments.paper.methods import CANNY, DEFAULT, GREY, LEARNT, TABLE_1, Method, column
from experiments.paper.results import (
    DATES,
    PROGRAM,
    Result,
    best_words,
    by_scene,
    difference,
    mean_and_error,
    percent,
    share_with_error,
    with_error,
)
from experiments.paper.runs import Workplace, geometry, head, save
from experiments.paper.scenes import Scene
from orthonav.core.tiles.represent import Canny
from orthonav.core.tiles.words import WordsRecipe, sift_features

Grey = NDArray[np.uint8]
Pair = tuple[Grey, Grey]
"""Tile of the map and view of the same place."""
BLUR_STD_PX = 1.0
"""Edges are compared smoothed by a Gaussian, so that those a pixel apart agree."""
FOUND_PX = 3.0
"""A feature is found again if the most similar one of the tile lies so near."""
FIGURE, SHOWN = "dates.png", ("A", "B")
"""Picture of these trajectories over generated landscapes; `docs/figures` has a copy."""
TITLE_PX, GAP_PX, WHITE = 24, 6, 255
GREY_STEP = 8
"""Grey levels of pictures are multiples of this: a PNG is half as large."""


def run(place: Workplace, chosen: Iterable[Scene]) -> None:
    """Write `dates.json` and `pictures` into the folder of results."""
    start, started, made = time.perf_counter(), provenance("paper pictures"), []
    strips: dict[str, list[Grey]] = {}
    for scene in chosen:
        scenes.render(scene)
        pairs = pairs_of(place, scene)
        made.append(head(place, scene, started) | {"views": len(pairs)} | alike(pairs))
        name = FIGURE if scene.name in SHOWN else f"{scene.name}.png"
        strips.setdefault(name, []).append(strip(scene, pairs[len(pairs) // 2]))
    save(place.out / DATES.name, {"scenes": made}, start)
    folder = place.out / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    for name, parts in strips.items():
        cv2.imwrite(str(folder / name), np.vstack(parts))


def pairs_of(place: Workplace, scene: Scene) -> list[Pair]:
    """The views on the grid, each with its tile."""
    localizer = geometry(place, scene)
    tiles = scenes.reference_tiles(scene, localizer)
    views = scenes.grid_views(scene, localizer, place.setting.views)
    return [(tiles[tile], view) for tile, view in views]


def alike(pairs: Sequence[Pair]) -> dict[str, float]:
    """Means over pairs: correlation of grey levels and of Canny edges, and features found again."""
    found = {
        "grey": [correlation(tile, view) for tile, view in pairs],
        "canny": [correlation(blurred(edges(a)), blurred(edges(b))) for a, b in pairs],
        "features": [found_again(view, tile) for tile, view in pairs],
    }
    return {name: float(np.mean(values)) for name, values in found.items()}


def edges(grey: Grey) -> NDArray[np.float32]:
    """Canny edges (H, W), 0 or 1, with the paper's thresholds."""
    return np.asarray(Canny()(grey, np.ones(grey.shape, np.bool_))[0], np.float32)


def blurred(seen: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(seen, (0, 0), BLUR_STD_PX), np.float32)


def correlation(one: NDArray[np.generic], other: NDArray[np.generic]) -> float:
    """Correlation coefficient of two pictures (H, W); 0 where one of them is flat."""
    a, b = (np.asarray(each, np.float64).ravel() for each in (one, other))
    a, b = a - a.mean(), b - b.mean()
    power = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / power if power else 0.0


def found_again(view: Grey, tile: Grey) -> float:
    """Share of the SIFT features of a view whose most similar feature of the tile is in place."""
    ours, theirs = (sift_features(each, WordsRecipe.max_features) for each in (view, tile))
    if not ours.keypoints or not theirs.keypoints:
        return 0.0
    pairs = cv2.BFMatcher(cv2.NORM_L2).match(ours.descriptors, theirs.descriptors)
    here, there = ours.points, theirs.points
    away = [here[pair.queryIdx] - there[pair.trainIdx] for pair in pairs]
    return float((np.hypot(*np.array(away).T) <= FOUND_PX).mean())


def strip(scene: Scene, pair: Pair) -> Grey:
    """Tile and view as grey levels, then as edges, side by side under their titles."""
    dates = scene.past.stem, scene.present.stem
    names = [f"{scene.name}, {dates[0]}, map", f"{dates[1]}, view", *(f"{d}, Canny" for d in dates)]
    greys = [each // GREY_STEP * GREY_STEP for each in pair]
    drawn = [WHITE - WHITE * edges(each).astype(np.uint8) for each in pair]
    return np.hstack([titled(*each) for each in zip(names, [*greys, *drawn], strict=True)])


def titled(title: str, picture: Grey) -> Grey:
    """The picture (H, W) with a title above and a gap to the next one."""
    height, width = picture.shape
    out = np.full((TITLE_PX + height + GAP_PX, width + GAP_PX), WHITE, np.uint8)
    out[TITLE_PX : TITLE_PX + height, :width] = picture
    cv2.rectangle(out, (0, TITLE_PX), (width - 1, TITLE_PX + height - 1), 0)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(out, title, (0, TITLE_PX - 7), font, 0.5, 0, 1, cv2.LINE_AA)
    return out


CANNY_EDGES, GREY_LEVELS, *OTHERS = (
    Method(family, family, look).label
    for family, look in (
        ("autoencoder", CANNY),
        ("autoencoder", GREY),
        ("autoencoder", LEARNT),
        ("bovw", GREY),
        (DEFAULT, DEFAULT),
    )
)
"""Columns of the table, each a method."""
COMPARED = (CANNY_EDGES, GREY_LEVELS, *OTHERS)
OURS = Method(DEFAULT, DEFAULT, DEFAULT, registration=True).label
DIFFERENCE = "Canny minus grey"
MEASURED = ("alike: grey", "alike: Canny", "SIFT found again")
HEADER = (
    *("scene", CANNY_EDGES, GREY_LEVELS, DIFFERENCE, *OTHERS),
    *("default, anywhere", *MEASURED),
)


def table(results: Sequence[Result]) -> list[Table]:
    """Canny edges and grey levels of each scene with standard errors, and their difference."""
    found = {
        scene: {each.method.label: each for each in best_words(rows)}
        for scene, rows in by_scene(results).items()
    }
    found = {scene: rows for scene, rows in found.items() if CANNY_EDGES in rows}
    real = [scene for scene in found if column(scene) not in TABLE_1]
    if not real:
        return []
    alike = json.loads(DATES.read_text(encoding="utf-8"))["scenes"] if DATES.is_file() else []
    measured = {each["scene"]: each for each in alike}
    drawn = [scene for scene in found if scene not in real]
    lines = [_row(found[scene], measured.get(scene)) for scene in (*drawn, *real)]
    body = [[line.get(name, "-") for name in HEADER] for line in lines]
    ends = _over_scenes([found[scene] for scene in real])
    body += [[line.get(name, "") for name in HEADER] for line in ends]
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
    return [Table("Canny or grey between dates", HEADER, body, notes)]


def _row(rows: dict[str, Result], measured: dict[str, float] | None) -> dict[str, str]:
    """A scene, by column: its results by label, and how alike its dates are."""
    first = rows[CANNY_EDGES]
    row = {"scene": first.scene}
    row |= {each: _accuracy(rows[each]) + rows[each].star for each in COMPARED if each in rows}
    if GREY_LEVELS in rows:
        apart = difference(first, rows[GREY_LEVELS], "grid")
        row[DIFFERENCE] = with_error(*apart, signed=True)
    if OURS in rows:
        row["default, anywhere"] = _accuracy(rows[OURS], "anywhere")
    if measured:
        grey, canny, features = (measured[name] for name in ("grey", "canny", "features"))
        row |= zip(MEASURED, (f"{grey:.2f}", f"{canny:.2f}", percent(features)), strict=True)
    return row


def _over_scenes(scenes: Sequence[dict[str, Result]]) -> Iterator[dict[str, str]]:
    """Means over real scenes, and on how many of them Canny edges are better or worse."""

    def mean(values: Sequence[float], *, signed: bool = False) -> str:
        shown = with_error(*mean_and_error(values), signed=signed)
        few = len(values) < len(scenes)
        return f"{shown} ({len(values)} of {len(scenes)})" if few else shown

    both = [rows for rows in scenes if GREY_LEVELS in rows]
    apart = [difference(rows[CANNY_EDGES], rows[GREY_LEVELS], "grid") for rows in both]
    means = {
        each: mean([rows[each].accuracy("grid") for rows in scenes if each in rows])
        for each in COMPARED
    }
    means[DIFFERENCE] = mean([each for each, _ in apart], signed=True)
    yield {"scene": "mean of the real scenes", **means}
    better, worse = (sum(sign * each > 2 * error for each, error in apart) for sign in (1, -1))
    counts = f"{better} / {worse} / {len(apart) - better - worse}"
    yield {"scene": "Canny better / worse / equal", DIFFERENCE: counts}


def _accuracy(each: Result, placement: str = "grid") -> str:
    right = each.right(placement)
    return share_with_error(int(right.sum()), len(right))
