"""Which sheets of an atlas a view may show: those with the most similar coarse tiles."""

import logging
import math
from functools import partial

import numpy as np

from orthonav.core.errors import AtlasError
from orthonav.core.localize.search import DEFAULT_PLAN
from orthonav.core.localize.view import (
    LIMITS,
    RectifiedView,
    check_footprint,
    check_view,
    downsampled,
    pose_prior,
    rectify_footprint,
)
from orthonav.core.records import NoFix, View
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import embed_directions
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.catalog import Atlas, CoarseRecipe
from orthonav.ground.atlas.coarse import EDGES
from orthonav.ground.atlas.index import (
    LEARNT,
    half_whitened,
    index_file,
    load_learnt,
    read_manifest,
    stale_sheets,
)
from orthonav.ground.atlas.vectors import NONE, ShardedIndex

log = logging.getLogger(__name__)

EFFORTS = (
    (10**6, 0.4, 300),
    (3 * 10**7, 0.25, 800),
    (math.inf, 0.085, 1500),
)
"""Greatest number of tiles, fraction of the lists scanned, tiles compared by their stored vectors:
finds 98 % of the tiles that exact search finds among 10^7, 95 % among 10^8
(`benchmarks.atlas_search` at d63ac91)."""


class SheetSearch:
    """The index of an atlas with its shards mapped. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        """Warns of sheets that are not in the index. Raises `AtlasError` without an index."""
        manifest = read_manifest(atlas)
        if manifest is None or atlas.recipe.coarse is None:
            raise AtlasError(
                "the atlas has no index: make it with 'orthonav atlas index', or build an atlas "
                f"with coarse tiles: {atlas.url}"
            )
        self.atlas = atlas
        self.recipe: CoarseRecipe = atlas.recipe.coarse
        if new := stale_sheets(atlas, manifest)[0]:
            log.warning(
                "%d sheets are missing from the index and are not searched; update it with "
                "'orthonav atlas index'",
                len(new),
            )
        file = partial(index_file, atlas, manifest)
        self._policy = DEFAULT_PLAN
        self._embedder, quantizers = load_learnt(file(LEARNT), manifest.recipe)
        self._representation = make_variant(represent.TABLE, EDGES)
        self._index = ShardedIndex(file, manifest.shards, quantizers)
        share, rerank = next(effort for most, *effort in EFFORTS if len(self._index) <= most)
        self._probes = max(1, round(share * manifest.recipe.lists))
        self._rerank = int(rerank)

    def sheets(self, view: View, heading_known: bool) -> list[str] | NoFix:
        """Names of the sheets with the tiles most similar to a view, best first, or why it cannot
        be searched."""
        refused = check_view(view, self.recipe.gsd_m, heading_known)
        if refused is not None:
            return refused
        coarse = self._rectified(view)
        if isinstance(coarse, NoFix):
            return coarse
        prior = pose_prior(view.telemetry, heading_known, view.camera.focal_std)
        directions = self._policy.directions(prior, self._policy.coarse_steps)
        poses = [pose for pose, nats in directions if nats <= self._policy.likely_nats]
        embedded = embed_directions(
            *(self._embedder, self._representation, coarse.grey, coarse.valid, poses),
            self.recipe.tile_px,
        )
        queries = half_whitened(self._embedder, embedded)
        scores, ids = self._index.search(queries, 20, self._probes, self._rerank)
        best_first = ids.ravel()[np.argsort(-scores, axis=None, kind="stable")]
        found = self._index.sheets_of(best_first[best_first != NONE])
        there = self.atlas.sheets()
        return [name for name in dict.fromkeys(found) if name in there]

    def _rectified(self, view: View) -> RectifiedView | NoFix:
        """At the resolution of the coarse tiles; `NoFix` unless about as wide as one."""
        gsd_m, tile_m = self.recipe.gsd_m, self.recipe.tile_m
        coarse = rectify_footprint(downsampled(view, gsd_m), gsd_m=gsd_m, multiple_px=1)
        side_m = math.sqrt(float(coarse.valid.sum())) * gsd_m
        least, most = (share * tile_m for share in self._policy.view_tiles)
        if least <= side_m <= most:
            return check_footprint(coarse, 1.0, LIMITS.min_view_px) or coarse
        return NoFix(
            "wrong_scale",
            f"view is {side_m:.0f} m wide; the coarse tiles of this atlas are for views of "
            f"{least:.0f} to {most:.0f} m",
        )
