"""Position rules: the paper's and those of the works it compares with.

"We use the position of the reference embedding leading to the highest scalar product, as we
observed that it yields better results than the weighted average" (section Methodology).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize import Localizer
from orthonav.core.localize.rectify import downsampled
from orthonav.core.localize.tiles import TileMatcher
from orthonav.core.mapfile import MapFile
from orthonav.core.records import View
from orthonav.core.tiles.position import RULES

SIMILARITIES = ("product", "cosine")


def compared(
    localizer: Localizer,
    opened: MapFile,
    views: list[View],
    truths_en_m: list[NDArray[np.float64]],
) -> dict[str, list[float]]:
    """Errors in m of views, by "similarity rule"; the same embeddings serve all."""
    placer, gsd_m = localizer.tiles, localizer.grid.gsd_m
    queries = []
    for view in views:
        smaller = downsampled(view, gsd_m)
        queries.append(placer.embedded([placer.rectified(smaller, view.telemetry.yaw_deg)]))
    centres = placer.centres_en_m
    tiles = opened.array("sheet0/embeddings", np.float16, 2)
    made = {}
    for similarity in SIMILARITIES:
        scaled = _unit(tiles).astype(np.float16) if similarity == "cosine" else tiles
        for rule in RULES:
            matcher = TileMatcher(localizer.grid, centres, scaled, rule)
            errors = []
            for query, truth in zip(queries, truths_en_m, strict=True):
                match = matcher.match(_unit(query) if similarity == "cosine" else query)
                found = centres[match.tile].astype(np.float64) + match.shift_en_m
                errors.append(float(np.hypot(*(found - truth))))
            made[f"{similarity} {rule}"] = errors
    return made


def _unit(vectors: NDArray[Any]) -> NDArray[np.float32]:
    values = np.asarray(vectors, dtype=np.float32)
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(norms, 1e-12), dtype=np.float32)
