"""Searching a view among the coarse tiles of a whole atlas."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from orthonav.core.errors import AtlasError
from orthonav.core.localize.rectify import RectifiedView
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import embed_poses
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.agreement import Placement, nearest_m
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.coarse import EDGES
from orthonav.ground.atlas.index import WHITENING_NAME, half_whitened, index_file, load_whitening
from orthonav.ground.atlas.index_manifest import read_manifest, stale_sheets
from orthonav.ground.atlas.index_shards import ShardedIndex
from orthonav.ground.atlas.recipe import CoarseRecipe

PER_POSE = 60
"""Tiles found for each pose; several neighbouring tiles are one place."""
EFFORTS = ((10**6, 0.4, 300), (3 * 10**7, 0.25, 800))
MOST_EFFORT = 0.085, 1500
"""Greatest number of tiles, share of the lists scanned, tiles compared by their stored vectors:
finds 98 % of the tiles that exact search finds among 10^7, 95 % among 10^8
(`python -m benchmarks.atlas_search`)."""
APART_STRIDES = 1.5
"""Tiles nearer to each other than this are one place: the eight neighbours of a tile."""
MAX_LAT_DEG = 89.8
"""Nearer to a pole a view has no meaningful heading."""


class TileSearch:
    """The index of an atlas with its shards mapped. Not to be shared between threads.

    `unknown` names the sheets that are not in the index, which are not found.
    """

    def __init__(self, atlas: Atlas) -> None:
        """Raises `AtlasError` where the atlas has no coarse tiles, or no valid index of them."""
        if atlas.recipe.coarse is None:
            raise AtlasError(
                f"the atlas has no coarse tiles, so views need a prior there: {atlas.url}"
            )
        manifest = read_manifest(atlas)
        if manifest is None:
            raise AtlasError(
                f"the atlas has no index: make it with 'orthonav atlas index': {atlas.url}"
            )
        self.atlas = atlas
        self.recipe: CoarseRecipe = atlas.recipe.coarse
        self.unknown = stale_sheets(atlas, manifest)[0]
        file = partial(index_file, atlas, manifest)
        self._embedder = load_whitening(file(WHITENING_NAME))
        self._representation = make_variant(represent.TABLE, EDGES)
        self._index = ShardedIndex(file, manifest.shards)
        if self._embedder.dims != self._index.quantizers.recipe.dims:
            raise AtlasError(f"files of the index do not fit together: {atlas.url}")
        efforts = (effort for most, *effort in EFFORTS if len(self._index) <= most)
        share, rerank = next(efforts, MOST_EFFORT)
        self._probes = max(1, round(share * manifest.recipe.lists))
        self._rerank = int(rerank)

    def matches(
        self, view: RectifiedView, poses: Sequence[tuple[float, float]], count: int
    ) -> list[Placement]:
        """The tiles most similar to a view under any of the poses, best first, apart from each
        other: their centres, which are the middle of the ground that the view shows.

        `view`: rectified to the resolution of the coarse tiles. `poses`: heading (rad) and log
        scale of each.
        """
        embedded = embed_poses(
            self._embedder,
            self._representation,
            view.grey,
            view.valid,
            poses,
            self.recipe.tile_px,
        )
        queries = half_whitened(self._embedder, embedded)
        per_pose = min(PER_POSE, len(self._index))
        scores, ids = self._index.search(queries, per_pose, self._probes, self._rerank)
        pose_of = np.repeat(np.arange(len(poses)), per_pose)
        flat_scores, flat_ids = scores.reshape(-1), ids.reshape(-1)
        order = np.argsort(-flat_scores, kind="stable")
        apart_m = APART_STRIDES * self.recipe.tile_m * (1 - self.recipe.overlap)
        found: list[Placement] = []
        for at in order[np.isfinite(flat_scores[order])].tolist():
            place = self._index.place_deg(int(flat_ids[at]))
            if place is None or abs(place[0]) > MAX_LAT_DEG or abs(place[1]) > 180:
                continue
            if nearest_m(place, [each.latlon_deg for each in found]) < apart_m:
                continue
            found.append(Placement(*place, *poses[int(pose_of[at])]))
            if len(found) == count:
                break
        return found
