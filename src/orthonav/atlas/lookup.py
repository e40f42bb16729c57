"""Looking for a view among the coarse tiles of a whole atlas."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav import represent
from orthonav.atlas.catalog import Atlas
from orthonav.atlas.coarse import EDGES
from orthonav.atlas.index import (
    WHITENING_NAME,
    IndexManifest,
    fetch_files,
    half_whitened,
    load_whitening,
    read_manifest,
    stale_sheets,
)
from orthonav.atlas.lost import Candidate
from orthonav.atlas.recipe import CoarseRecipe
from orthonav.atlas.vector_search import ShardedIndex
from orthonav.embed.bank import embed_poses
from orthonav.errors import AtlasError
from orthonav.geo.frames import distances_m
from orthonav.localizer.rectify import RectifiedView
from orthonav.variants import make_variant

PER_POSE = 60
"""Tiles looked at for each pose."""
EFFORTS = ((10**6, 0.4, 300), (3 * 10**7, 0.25, 800))
MOST_EFFORT = 0.085, 1500
"""Share of all lists that are searched, and tiles compared as they are stored, where there are no
more tiles than the first: what finds 98 % of what exact search finds among 10^7 tiles, 95 % among
10^8 (`python -m benchmarks.atlas_search`)."""
APART_STRIDES = 1.5
MAX_LAT_DEG = 89.8


class AtlasLookup:
    """The index of an atlas, its shards mapped. Not to be shared between threads.

    Sheets that the index does not know are found by no view: `unknown` names them. A context
    manager.
    """

    def __init__(self, atlas: Atlas) -> None:
        """Raises `AtlasError` where the atlas has no coarse tiles, or no index of them."""
        if atlas.recipe.coarse is None:
            raise AtlasError(
                f"the atlas has no coarse tiles; views need a prior there: {atlas.url}"
            )
        manifest = read_manifest(atlas)
        if manifest is None:
            raise AtlasError(
                f"the atlas has no index: make it with 'orthonav atlas index': {atlas.url}"
            )
        self.atlas = atlas
        self.recipe: CoarseRecipe = atlas.recipe.coarse
        self.unknown = stale_sheets(atlas, manifest)[0]
        self._folder = tempfile.TemporaryDirectory(prefix="orthonav-index-")
        folder = Path(self._folder.name)
        fetch_files(atlas, manifest, folder)
        self._embedder = load_whitening(folder / WHITENING_NAME)
        self._representation = make_variant(represent.TABLE, EDGES)
        names = [shard.name for shard in manifest.shards]
        self._index = ShardedIndex.open(folder, names)
        told = [(each.shard.base, each.shard.rows) for each in self._index.shards]
        if told != [(shard.base, shard.rows) for shard in manifest.shards]:
            raise AtlasError(f"index of the atlas does not fit together: {atlas.url}")
        self._manifest = manifest
        self._places = [_places(folder, manifest, number) for number in range(len(names))]
        tiles = len(self._index)
        efforts = (effort for most, *effort in EFFORTS if tiles <= most)
        share, rerank = next(efforts, MOST_EFFORT)
        self.probes, self.rerank = max(1, round(share * manifest.recipe.lists)), int(rerank)
        if self._embedder.dims != self._index.trained.dims:
            raise AtlasError(f"index of the atlas does not fit together: {atlas.url}")

    def __enter__(self) -> "AtlasLookup":
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def __len__(self) -> int:
        return len(self._index)

    def queries(
        self, view: RectifiedView, poses: Sequence[tuple[float, float]]
    ) -> NDArray[np.float32]:
        """Vectors (Q, D) of a view at the resolution of the coarse tiles, under poses."""
        embedded = embed_poses(
            self._embedder,
            self._representation,
            view.grey,
            view.valid,
            poses,
            self.recipe.tile_px,
        )
        return half_whitened(self._embedder, embedded)

    def candidates(
        self,
        view: RectifiedView,
        poses: Sequence[tuple[float, float]],
        count: int,
        *,
        exact: bool = False,
    ) -> list[Candidate]:
        """Tiles most like the view under some of the poses, best first, apart from each other.

        With `exact` every tile of the atlas is compared: the oracle, slow.
        """
        queries = self.queries(view, poses)
        per_pose = min(PER_POSE, len(self._index))
        if exact:
            scores, ids = self._index.exact(queries, per_pose)
        else:
            scores, ids = self._index.search(queries, per_pose, self.probes, self.rerank)
        pose_of = np.repeat(np.arange(len(poses)), per_pose)
        flat_scores, flat_ids = scores.reshape(-1), ids.reshape(-1)
        order = np.argsort(-flat_scores, kind="stable")
        apart_m = APART_STRIDES * self.recipe.tile_m * (1 - self.recipe.overlap)
        found: list[Candidate] = []
        taken = np.zeros((count, 2))
        for at in order[np.isfinite(flat_scores[order])].tolist():
            place = self._place(int(flat_ids[at]))
            near = taken[: len(found)]
            if place is None or (len(near) and _nearest_m(place, near) < apart_m):
                continue
            taken[len(found)] = place
            turn, scale = poses[int(pose_of[at])]
            found.append(Candidate(*place, turn, scale, float(flat_scores[at])))
            if len(found) == count:
                break
        return found

    def _place(self, number: int) -> tuple[float, float] | None:
        for shard, places in zip(self._manifest.shards, self._places, strict=True):
            if shard.base <= number < shard.base + shard.rows:
                lat, lon = places[number - shard.base].tolist()
                return (lat, lon) if abs(lat) <= MAX_LAT_DEG and abs(lon) <= 180 else None
        return None


def _nearest_m(place: tuple[float, float], others: NDArray[np.float64]) -> float:
    """Distance to the nearest of places (N, 2), by the ellipsoid only where it may be near."""
    if np.abs(others[:, 0] - place[0]).min() > 1.0:
        return float("inf")
    return float(distances_m([place] * len(others), others).min())


def _places(folder: Path, manifest: IndexManifest, number: int) -> NDArray[np.float64]:
    shard = manifest.shards[number]
    path = folder / f"{shard.name}.places.npy"
    try:
        places = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise AtlasError(f"places of an index cannot be read ({error}): {path}") from error
    if places.shape != (shard.rows, 2) or places.dtype != np.float64:
        raise AtlasError(f"places of an index are damaged: {path}")
    return np.asarray(places)
