"""`python -m experiments.paper.words`: what the bag of words finds on the reduced A and B, and why.

Views on the grid, of the date of the map and of the later date, with several vocabularies,
similarities and numbers of features. The results go to `words.json` beside this file.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.record import Table, number, provenance, say
from numpy.typing import NDArray

from experiments.paper import scenes
from experiments.paper.dates import found_again
from experiments.paper.methods import REDUCED, TILE_PX
from experiments.paper.results import ACCURACY_M, PROGRAM, WORDS, share_with_error
from experiments.paper.runs import Workplace, geometry, head, save
from experiments.paper.scenes import Scene
from orthonav.core.tiles.words import WordsEmbedder, WordsRecipe, describe
from orthonav.ground.build.encoders import MAX_WORD_TILES
from orthonav.research.words import learn_words

Array = NDArray[np.float64]
COMMAND = f"{PROGRAM}.words"
PAPER = (("product", 0),)
WAYS = (*PAPER, ("cosine", 0), ("cosine", 1))
"""Similarity of two bags, and whether words are weighed by tf-idf."""
FEW = ((256, 2000, PAPER), (1000, 2000, WAYS))
MORE = ((1000, 500, WAYS), (3000, 2000, PAPER))
TRIED = {"A": FEW, "B": FEW + MORE}
"""Words, features of a picture, and ways; fewer on A, which has five times the tiles of B."""
ALL = np.ones((TILE_PX, TILE_PX), np.bool_)


def main() -> None:
    """Measure both trajectories and write the file."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("paper_results"), metavar="DIR")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    place = Workplace(options.work, REDUCED, COMMAND)
    start, started, made = time.perf_counter(), provenance("paper words"), []
    for name in TRIED:
        scene = scenes.generated(REDUCED, name, options.work / "areas")
        scenes.render(scene)
        made.append(head(place, scene, started) | measured(place, scene))
    save(WORDS, {"scenes": made}, start)


def measured(place: Workplace, scene: Scene) -> dict[str, Any]:
    """Views within 15 m by vocabulary, rank of the correct tile, and features found again.

    Views are of the map's date ("same") or the later one ("other"); "elsewhere": another tile.
    """
    localizer, began = geometry(place, scene), time.perf_counter()
    centres = localizer.tiles.centres_en_m
    tiles = scenes.reference_tiles(scene, localizer)
    flown = {"same": replace(scene, present=scene.past), "other": scene}
    seen = {
        date: list(scenes.grid_views(each, localizer, place.setting.views))
        for date, each in flown.items()
    }
    pictures = {"map": tiles} | {date: [view for _, view in seen[date]] for date in seen}
    far = np.roll([tile for tile, _ in seen["other"]], len(seen["other"]) // 2).tolist()
    compared = seen | {"elsewhere": list(zip(far, pictures["other"], strict=True))}
    again = {
        date: float(np.mean([found_again(view, tiles[tile]) for tile, view in pairs]))
        for date, pairs in compared.items()
    }
    rows, described = [], {}
    for words, features, ways in TRIED[scene.name]:
        recipe = WordsRecipe(words=words, max_features=features, tfidf=1)
        for date, greys in pictures.items():
            if (features, date) not in described:
                described[features, date] = [describe(recipe, grey, ALL) for grey in greys]
        chosen = tiles[:: -(-len(tiles) // MAX_WORD_TILES)]
        embedder = learn_words(recipe, ((tile, ALL) for tile in chosen), seed=0)
        counts = {date: counted(embedder, described[features, date]) for date in pictures}
        for similarity, tfidf in ways:
            row = {"words": words, "features": features, "similarity": similarity, "tfidf": tfidf}
            bags = {d: weighed(each, embedder.idf, similarity, tfidf) for d, each in counts.items()}
            for date in seen:
                scores = bags[date] @ bags["map"].T
                row[date] = placed(scores, [tile for tile, _ in seen[date]], centres)
            rows.append(row)
        say(f"{scene.name}: {words} words, {time.perf_counter() - began:.0f} s")
    return {"found_again": again, "rows": rows}


def counted(embedder: WordsEmbedder, described: Sequence[NDArray[np.float32]]) -> NDArray[np.int64]:
    """Features (N, k) of each word in pictures, by their descriptors (F, D)."""
    return np.array([np.bincount(embedder.assigned(d), minlength=embedder.dims) for d in described])


def weighed(counts: NDArray[Any], idf: NDArray[Any], similarity: str, tfidf: int) -> Array:
    """Bags (N, k) of counts (N, k)."""
    bags = counts / np.maximum(1, counts.sum(axis=1, keepdims=True)) * (idf if tfidf else 1.0)
    if similarity == "cosine":
        bags /= np.maximum(np.linalg.norm(bags, axis=1, keepdims=True), 1e-12)
    return np.asarray(bags, np.float64)


def placed(scores: Array, correct: Sequence[int], centres_en_m: NDArray[Any]) -> dict[str, Any]:
    """Views within 15 m of all, by scores (V, N), and the median share of tiles above the correct
    one, 0 to 1: a half by chance."""
    away = np.hypot(*(centres_en_m[scores.argmax(axis=1)] - centres_en_m[correct]).T)
    own = scores[np.arange(len(correct)), correct]
    above = (scores > own[:, None]).mean(axis=1)
    return {"right": [int((away <= ACCURACY_M).sum()), len(away)], "above": float(np.median(above))}


def table() -> Table:
    """The bag of words by vocabulary and similarity, on views of the map's date and of another."""
    found = json.loads(WORDS.read_text(encoding="utf-8"))["scenes"]
    rows = [
        [
            *(each["scene"], f"{row['words']:,}", f"{row['features']:,}"),
            row["similarity"] + (", tf-idf" if row["tfidf"] else ""),
            *(share_with_error(*row[date]["right"]) for date in ("same", "other")),
            number(100 * row["other"]["above"]),
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
    most = max(row["same"]["above"] for each in found for row in each["rows"])
    notes = (
        "views on the grid: accuracy at 15 m in % with its standard error; features: most SIFT "
        "features of a picture; tiles above: median share of the tiles with a higher score than "
        f"the correct one, in %, 50 by chance; of the same date up to {number(100 * most)}",
        "SIFT features of a view whose most similar feature of the tile is within 3 px, in %, same "
        f"date / other date / another tile: {'; '.join(again)}",
        f"made by `{found[0]['command']}` at {about['commit'][:10]}, {about['date'][:10]}",
    )
    header = (
        *("scene", "words", "features", "similarity", "same date", "other date"),
        "tiles above",
    )
    return Table("Bag of words between dates", header, rows, notes)


if __name__ == "__main__":
    main()
